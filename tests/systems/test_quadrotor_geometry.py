"""What is drawn of a quadrotor, against SciPy's rotations and the plant's own mixing."""

import math

import numpy as np
from pydrake.geometry import Cylinder, Role, SceneGraph
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource
import pytest
from scipy.spatial.transform import Rotation
from systems.quadrotor_geometry import FRONT_COLOR, AddQuadrotorGeometry

from sgvf_drake.exceptions import ConfigurationError, NonFiniteValueError
from systems import QuadrotorParameters

PARAMETERS = QuadrotorParameters(arm_length=0.2)


class Picture:
    """A SceneGraph with quadrotors in given states, by name."""

    def __init__(self, scale=1.0, **states):
        builder = DiagramBuilder()
        self.scene_graph = builder.AddSystem(SceneGraph())
        for name, state in states.items():
            source = builder.AddSystem(ConstantVectorSource(state))
            AddQuadrotorGeometry(
                builder,
                source.get_output_port(),
                self.scene_graph,
                PARAMETERS,
                name,
                scale=scale,
            )
        self.diagram = builder.Build()
        self.context = self.diagram.CreateDefaultContext()
        self.inspector = self.scene_graph.model_inspector()

    def pose(self, name):
        own = self.scene_graph.GetMyContextFromRoot(self.context)
        query = self.scene_graph.get_query_output_port().Eval(own)
        frame = next(
            f for f in self.inspector.GetAllFrameIds() if self.inspector.GetName(f) == name
        )
        return query.GetPoseInWorld(frame)

    def shapes(self):
        """The geometries by name."""
        ids = self.inspector.GetAllGeometryIds(Role.kIllustration)
        return {self.inspector.GetName(g).split("::")[-1]: g for g in ids}

    def propellers(self):
        shapes = self.shapes()
        return [shapes[f"propeller_{number}"] for number in range(4)]


@pytest.mark.parametrize("seed", range(5))
def test_the_frame_has_the_pose_of_the_state(seed):
    state = np.random.default_rng(seed).uniform(-1.4, 1.4, 12)
    X_WB = Picture(quadrotor=state).pose("quadrotor")
    # Extrinsic rotations about x, y, z are roll, then pitch, then yaw.
    R_WB = Rotation.from_euler("xyz", state[3:6]).as_matrix()
    np.testing.assert_allclose(X_WB.rotation().matrix(), R_WB, atol=1e-14)
    np.testing.assert_array_equal(X_WB.translation(), state[:3])


@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_the_propellers_stand_where_their_forces_act(scale):
    picture = Picture(scale, quadrotor=np.zeros(12))
    centers = np.array(
        [picture.inspector.GetPoseInFrame(g).translation() for g in picture.propellers()]
    )
    # The torque of a unit force along z is p x e_z.
    torque = np.cross(centers, [0.0, 0.0, 1.0])
    mixing = PARAMETERS.MixingMatrix()
    np.testing.assert_allclose(torque[:, :2].T, scale * mixing[1:3], atol=1e-15)
    assert (centers[:, 2] > 0.0).all()


def test_the_propellers_are_equal_flat_discs_that_do_not_touch():
    picture = Picture(quadrotor=np.zeros(12))
    discs = [picture.inspector.GetShape(g) for g in picture.propellers()]
    assert all(isinstance(disc, Cylinder) for disc in discs)
    assert len({(disc.radius(), disc.length()) for disc in discs}) == 1
    assert 2.0 * discs[0].radius() < math.sqrt(2.0) * PARAMETERS.arm_length
    assert discs[0].length() < 0.2 * discs[0].radius()
    for g in picture.propellers():
        R_BG = picture.inspector.GetPoseInFrame(g).rotation().matrix()
        np.testing.assert_array_equal(R_BG, np.eye(3))


def test_only_the_propeller_in_front_has_its_color():
    picture = Picture(quadrotor=np.zeros(12))
    colors = {
        name: picture.inspector.GetIllustrationProperties(g).GetProperty("phong", "diffuse")
        for name, g in picture.shapes().items()
    }
    assert [name for name, color in colors.items() if color == FRONT_COLOR] == ["propeller_0"]
    front = picture.inspector.GetPoseInFrame(picture.propellers()[0]).translation()
    assert front[0] > 0.0
    assert front[1] == 0.0


def test_the_arms_reach_from_motor_to_motor():
    picture = Picture(quadrotor=np.zeros(12))
    for name, axis in (("arm_x", 0), ("arm_y", 1)):
        g = picture.shapes()[name]
        along = picture.inspector.GetPoseInFrame(g).rotation().matrix()[:, 2]
        assert abs(along[axis]) == pytest.approx(1.0)
        assert picture.inspector.GetShape(g).length() == 2.0 * PARAMETERS.arm_length


def test_nothing_can_collide():
    picture = Picture(quadrotor=np.zeros(12))
    assert len(picture.shapes()) == 7
    assert picture.inspector.NumGeometriesWithRole(Role.kProximity) == 0


def test_two_vehicles_have_a_frame_each():
    picture = Picture(one=np.full(12, 0.1), other=np.full(12, 0.2))
    assert picture.pose("one").translation().tolist() == [0.1] * 3
    assert picture.pose("other").translation().tolist() == [0.2] * 3


def test_a_state_that_is_not_finite_is_named():
    state = np.zeros(12)
    state[7] = np.nan
    picture = Picture(quadrotor=state)
    with pytest.raises(NonFiniteValueError, match=r"quadrotor_geometry: input port 'state'"):
        picture.pose("quadrotor")


@pytest.mark.parametrize("scale", [0.0, -1.0, np.nan, np.inf])
def test_a_scale_that_cannot_be_used_is_named(scale):
    with pytest.raises(ConfigurationError, match=r"scale must be finite and positive"):
        Picture(scale, quadrotor=np.zeros(12))
