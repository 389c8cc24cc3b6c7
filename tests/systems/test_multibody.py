"""A quadrotor of a MultibodyPlant against QuadrotorPlant, alone and among other bodies."""

import math

import numpy as np
from pydrake.autodiffutils import InitializeAutoDiff
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import (
    ExternallyAppliedSpatialForce,
    MultibodyPlant,
)
from pydrake.multibody.tree import QuaternionFloatingJoint, RevoluteJoint, WeldJoint
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantValueSource, LogVectorOutput
import pytest

from sgvf_drake.exceptions import ConfigurationError, NonFiniteValueError
from systems import (
    DEFAULT_GAINS,
    AddGuidance,
    AddMultibodyQuadrotor,
    FloatingBodyState,
    MakeSimulator,
    MultibodyQuadrotor,
    MultibodyQuadrotorSdf,
    QuadrotorParameters,
    SetHover,
    SetVehicleState,
)
from systems.scalars import Split

from .flying import PARAMETERS, STATE, TWO_RINGS

STARTS = ((1.25, 0.0, 1.0), (-1.9, 0.0, 1.2), (0.0, 1.2, 0.8), (0.0, -1.8, 1.0), (0.7, 0.7, 1))

HEAVIER = QuadrotorParameters(
    mass=0.9,
    arm_length=0.12,
    thrust_to_weight=2.5,
    inertia=(2e-3, 3e-3, 4e-3),
    force_constant=2.0,
    moment_constant=0.03,
)

CRATES = """
<sdf version="1.9"><model name="crates">
  <link name="falling"><inertial><mass>2</mass></inertial></link>
  <link name="swinging"><pose>3 0 2 0 0 0</pose><inertial><mass>1</mass>
    <pose>0.5 0 0 0 0 0</pose></inertial></link>
  <joint name="hinge" type="revolute"><parent>world</parent><child>swinging</child>
    <axis><xyz>0 1 0</xyz></axis></joint>
</model></sdf>
"""

CAMERA = """
<sdf version="1.9"><model name="camera"><link name="camera"><inertial><mass>0.1</mass>
  <inertia><ixx>1e-4</ixx><iyy>1e-4</iyy><izz>1e-4</izz></inertia></inertial></link></model></sdf>
"""

# Of a user: of two welded links, which together are the heavier vehicle.
USERS = """
<sdf version="1.9"><model name="mine">
  <link name="frame"><inertial><mass>0.5</mass><inertia>
    <ixx>1e-3</ixx><iyy>2e-3</iyy><izz>2e-3</izz></inertia></inertial></link>
  <link name="battery"><inertial><mass>0.4</mass><inertia>
    <ixx>1e-3</ixx><iyy>1e-3</iyy><izz>2e-3</izz></inertia></inertial></link>
  <joint name="weld" type="fixed"><parent>frame</parent><child>battery</child></joint>
</model></sdf>
"""


class Scene:
    """Quadrotors, each with guidance, in one MultibodyPlant among what else is added."""

    def __init__(self, models, add=lambda builder, scene: None, time_step=0.0):
        self.builder = builder = DiagramBuilder()
        self.plant = builder.AddNamedSystem("world", MultibodyPlant(time_step))
        self.parser = Parser(self.plant)
        instances = [self.parser.AddModelsFromString(sdf, "sdf")[0] for sdf, _ in models]
        add(builder, self)
        if not self.plant.is_finalized():
            self.plant.Finalize()
        self.quadrotors = [
            AddMultibodyQuadrotor(builder, self.plant, instance, parameters)
            for instance, (_, parameters) in zip(instances, models, strict=True)
        ]
        for number, quadrotor in enumerate(self.quadrotors):
            AddGuidance(builder, TWO_RINGS, quadrotor, name=f"loop {number}")
        self.logs = [
            LogVectorOutput(quadrotor.GetOutputPort("state"), builder, 0.01)
            for quadrotor in self.quadrotors
        ]
        self.diagram = builder.Build()

    def fly(self, duration):
        simulator = MakeSimulator(self.diagram)
        self.context = simulator.get_mutable_context()
        for number in range(len(self.quadrotors)):
            SetHover(self.diagram, self.context, STARTS[number], f"loop {number}")
        simulator.AdvanceTo(duration)
        return [log.FindLog(self.context).data() for log in self.logs]


def model(parameters=PARAMETERS, name="quadrotor"):
    return MultibodyQuadrotorSdf(parameters, name), parameters


def fly(plant, parameters, duration, start=STARTS[0]):
    """The states of a plant alone, with guidance, (12, T)."""
    builder = DiagramBuilder()
    builder.AddNamedSystem("plant", plant)
    AddGuidance(builder, TWO_RINGS, plant, parameters)
    log = LogVectorOutput(plant.GetOutputPort("state"), builder, 0.01)
    diagram = builder.Build()
    simulator = MakeSimulator(diagram)
    SetHover(diagram, simulator.get_mutable_context(), start)
    simulator.AdvanceTo(duration)
    return log.FindLog(simulator.get_context()).data()


def random_state(rng):
    """Any position, yaw and rates, and any attitude that roll-pitch-yaw has."""
    return rng.uniform(-1.0, 1.0, 12) * [*[5.0] * 3, 3.1, 1.5, 3.1, *[3.0] * 3, *[5.0] * 3]


@pytest.mark.parametrize("parameters", [PARAMETERS, HEAVIER])
@pytest.mark.parametrize("seed", range(3))
def test_the_equations_are_those_of_quadrotor_plant(parameters, seed):
    """The rate of the state, by automatic differentiation along that of the MultibodyPlant."""
    rng = np.random.default_rng(seed)
    quadrotor, multibody = parameters.MakePlant(), MultibodyQuadrotor(parameters)
    converted = multibody.ToAutoDiffXd()
    for _ in range(5):
        state, force = random_state(rng), rng.uniform(0.0, 3.0, 4)
        own = quadrotor.CreateDefaultContext()
        own.SetContinuousState(state)
        quadrotor.get_input_port().FixValue(own, force)
        expected = quadrotor.EvalTimeDerivatives(own).CopyToVector()
        context = multibody.CreateDefaultContext()
        multibody.SetVehicleState(context, state)
        multibody.GetInputPort("propeller_force").FixValue(context, force)
        np.testing.assert_allclose(
            multibody.GetOutputPort("state").Eval(context), state, rtol=1e-9, atol=1e-12
        )
        along = converted.CreateDefaultContext()
        along.SetContinuousState(
            InitializeAutoDiff(
                context.get_continuous_state_vector().CopyToVector(),
                multibody.EvalTimeDerivatives(context).CopyToVector()[:, np.newaxis],
            )
        )
        _, rates = Split(converted.GetOutputPort("state").Eval(along))
        np.testing.assert_allclose(rates[:, 0], expected, rtol=1e-8, atol=1e-8)


def test_a_flight_is_that_of_quadrotor_plant():
    multibody, quadrotor = (
        fly(plant, None, 3.0) for plant in (MultibodyQuadrotor(), PARAMETERS.MakePlant())
    )
    np.testing.assert_allclose(multibody, quadrotor, rtol=0, atol=1e-6)
    np.testing.assert_allclose(multibody[:3], quadrotor[:3], rtol=0, atol=1e-7)


def test_a_discrete_plant_flies_the_same_path_less_exactly():
    """Its error is of first order in its time step."""
    exact = fly(MultibodyQuadrotor(), None, 2.0)[:3]
    errors = [
        np.abs(fly(MultibodyQuadrotor(time_step=step), None, 2.0)[:3] - exact).max()
        for step in (0.005, 0.0025)
    ]
    assert errors[0] < 0.01
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.1)


@pytest.mark.parametrize("count", [2, 5])
def test_several_in_one_plant_fly_as_each_alone(count):
    scene = Scene([model(name=f"quadrotor {number}") for number in range(count)])
    for start, flight in zip(STARTS, scene.fly(1.0), strict=False):
        alone = fly(MultibodyQuadrotor(), None, 1.0, start)
        np.testing.assert_allclose(flight, alone, rtol=0, atol=1e-11)


def test_a_users_model_flies_among_other_bodies():
    """Its mass and inertia are read, all bodies that are welded together."""
    scene = Scene(
        [(USERS, HEAVIER), model(name="another")],
        lambda _, scene: scene.parser.AddModelsFromString(CRATES, "sdf"),
    )
    read = scene.quadrotors[0].parameters
    assert read.mass == pytest.approx(HEAVIER.mass)
    assert read.inertia == pytest.approx(HEAVIER.inertia)
    assert read.arm_length == HEAVIER.arm_length
    users, another = scene.fly(1.0)
    alone = fly(HEAVIER.MakePlant(), HEAVIER, 1.0)
    np.testing.assert_allclose(users[:3], alone[:3], rtol=0, atol=1e-7)
    alone = fly(PARAMETERS.MakePlant(), None, 1.0, STARTS[1])
    np.testing.assert_allclose(another[:3], alone[:3], rtol=0, atol=1e-7)
    own = scene.plant.GetMyContextFromRoot(scene.context)
    crate = scene.plant.GetBodyByName("falling")
    height = scene.plant.EvalBodyPoseInWorld(own, crate).translation()[2]
    assert height == pytest.approx(-9.81 / 2.0)


@pytest.mark.parametrize("joint", [WeldJoint, RevoluteJoint])
def test_what_is_joined_from_another_model_is_part_of_the_vehicle(joint):
    def add(_, scene):
        scene.parser.AddModelsFromString(CAMERA, "sdf")
        frames = [scene.plant.GetFrameByName(name) for name in ("body", "camera")]
        where = RigidTransform() if joint is WeldJoint else [0.0, 0.0, 1.0]
        scene.plant.AddJoint(joint("mount", *frames, where))

    if joint is RevoluteJoint:
        with pytest.raises(ConfigurationError, match="joints that move"):
            Scene([model()], add)
    else:
        read = Scene([model()], add).quadrotors[0].parameters
        assert read.mass == pytest.approx(PARAMETERS.mass + 0.1)
        assert read.inertia == pytest.approx(np.array(PARAMETERS.inertia) + 1e-4)


def test_forces_that_a_body_had_before_are_added_up():
    """A force of a tenth of the weight, which the law has no integral action against."""

    def lift(builder, scene):
        scene.plant.Finalize()
        force = ExternallyAppliedSpatialForce()
        force.body_index = scene.plant.GetBodyByName("body").index()
        force.F_Bq_W = SpatialForce([0.0] * 3, [0.0, 0.0, PARAMETERS.weight / 10.0])
        source = builder.AddSystem(ConstantValueSource(Value([force])))
        builder.Connect(
            source.get_output_port(), scene.plant.get_applied_spatial_force_input_port()
        )

    scene = Scene([model()], lift)
    (state,) = scene.fly(5.0)
    # It is k_v times the descent that is commanded, tanh of twice the error in m/s.
    error = math.atanh(0.1 * PARAMETERS.gravity / DEFAULT_GAINS.velocity_gain) / 2.0
    assert state[2, -1] == pytest.approx(STARTS[0][2] + error, abs=1e-3)


def test_the_state_of_a_vehicle_is_set_in_its_plant():
    scene = Scene([model(name="first"), model(name="second")])
    context = scene.diagram.CreateDefaultContext()
    SetVehicleState(scene.diagram, context, STATE, "loop 1")
    for quadrotor, expected in zip(scene.quadrotors, (np.zeros(12), STATE), strict=True):
        port = quadrotor.GetOutputPort("state")
        found = port.Eval(quadrotor.GetMyContextFromRoot(context))
        np.testing.assert_allclose(found, expected, atol=1e-14)


def test_a_quaternion_of_another_length_is_the_same_attitude():
    system = FloatingBodyState()
    context = system.CreateDefaultContext()
    rest = [1.0, 2.0, 3.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6]
    states = []
    for scale in (1.0, 1.1):
        quaternion = (scale * np.array([0.9, 0.1, -0.2, 0.3])).tolist()
        system.get_input_port().FixValue(context, [*quaternion, *rest])
        states.append(system.get_output_port().Eval(context))
    np.testing.assert_allclose(*states, rtol=1e-13)
    system.get_input_port().FixValue(context, [*[0.5] * 4, np.nan, *rest[1:]])
    with pytest.raises(NonFiniteValueError, match="body_state"):
        system.get_output_port().Eval(context)


def link(name, body="", **inertial):
    """A link in SDFormat."""
    values = {"ixx": 1e-3, "iyy": 1e-3, "izz": 1e-3, **inertial}
    pose = values.pop("pose", "0 0 0 0 0 0")
    inertia = "".join(f"<{key}>{value}</{key}>" for key, value in values.items())
    return (
        f'<link name="{name}"><inertial><pose>{pose}</pose><mass>1</mass>'
        f"<inertia>{inertia}</inertia></inertial></link>{body}"
    )


HINGE = (
    '<joint name="hinge" type="revolute"><parent>a</parent><child>b</child>'
    "<axis><xyz>0 0 1</xyz></axis></joint>"
)
GROUND = '<joint name="ground" type="fixed"><parent>world</parent><child>a</child></joint>'


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (link("a", GROUND), "floats without a joint, it has 0"),
        (link("a") + link("b"), "floats without a joint, it has 2"),
        (link("a") + link("b") + HINGE, "joints that move"),
        (link("a", pose="0 0.01 0 0 0 0"), r"centre of mass at \[0.0, 0.01, 0.0\] m"),
        (link("a", ixy=1e-4), "diagonal inertia"),
    ],
)
def test_a_model_that_cannot_be_flown_is_refused_with_the_reason(content, reason):
    sdf = f'<sdf version="1.9"><model name="odd">{content}</model></sdf>'
    with pytest.raises(ConfigurationError, match=f"'odd'.*{reason}"):
        Scene([(sdf, PARAMETERS)])


def jointed(_, scene):
    """As it floats anyway, but by a joint that could be elsewhere."""
    frames = scene.plant.world_frame(), scene.plant.GetFrameByName("body")
    scene.plant.AddJoint(QuaternionFloatingJoint("base", *frames))


def pulled_sideways(_, scene):
    scene.plant.mutable_gravity_field().set_gravity_vector([1.0, 0.0, -9.0])


def without_gravity(_, scene):
    instance = scene.plant.GetModelInstanceByName("quadrotor")
    scene.plant.set_gravity_enabled(instance, False)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (jointed, "floats without a joint, it has 0"),
        (pulled_sideways, "gravity"),
        (without_gravity, "gravity"),
    ],
)
def test_another_base_and_another_gravity_are_refused(change, reason):
    with pytest.raises(ConfigurationError, match=f"'quadrotor'.*{reason}"):
        Scene([model()], change)


def added(builder, plant, **options):
    instance = plant.GetModelInstanceByName("quadrotor")
    return AddMultibodyQuadrotor(builder, plant, instance, **options)


def test_misuse_is_one_error_before_anything_is_added():
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModelsFromString(MultibodyQuadrotorSdf(PARAMETERS), "sdf")
    builder = DiagramBuilder()
    with pytest.raises(ConfigurationError, match="not in the builder"):
        added(builder, plant)
    builder.AddNamedSystem("world", plant)
    with pytest.raises(ConfigurationError, match="not finalized"):
        added(builder, plant)
    plant.Finalize()
    with pytest.raises(ConfigurationError, match="'world' already"):
        added(builder, plant, name="world")
    assert len(builder.GetSystems()) == 1
    added(builder, plant)
    with pytest.raises(ConfigurationError, match="propellers already"):
        added(builder, plant, name="again")
    assert len(builder.GetSystems()) == 2


def test_an_exported_input_of_forces_is_refused():
    def export(builder, scene):
        scene.plant.Finalize()
        builder.ExportInput(scene.plant.get_applied_spatial_force_input_port())

    with pytest.raises(ConfigurationError, match="exported"):
        Scene([model()], export)
