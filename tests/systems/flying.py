"""Fields in closed form, and flights around their paths, that the tests of systems share."""

from itertools import pairwise
import math

import numpy as np
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput
import pytest
import sympy

from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import ConfigurationError
from systems import (
    AddGuidance,
    Branch,
    BranchSupervisor,
    Dropout,
    MakeSimulator,
    Mode,
    QuadrotorParameters,
    SetHover,
    SetNoiseSeed,
)
from systems.quadrotor import POSITION, VELOCITY
from systems.supervision import Memory

PARAMETERS = QuadrotorParameters()
SPEED = 0.45
LAP = 2.0 * math.pi
ANGLES = np.linspace(0.0, LAP, 60, endpoint=False)
UNIT = np.column_stack([np.cos(ANGLES), np.sin(ANGLES)])
STATE = np.array([1.1, 0.2, 0.9, 0.05, -0.02, 0.1, 0.1, 0.4, 0.0, 0.1, 0.0, 0.05])


class CircleField:
    """A guiding field of unit length around the unit circle, counter-clockwise.

    The direction is the unit tangent plus `gain` times (1 - r) radially, normalised.  In
    three dimensions the circle lies in the plane z = 1 and `gain` also pulls to that plane.
    The derivatives are SymPy's, so they are exact and owe nothing to the code under test.
    """

    def __init__(self, dim=2, gain=3.0, radius=lambda r: 1, height=lambda r: 1):
        self.dim, self.calls = dim, 0
        p = sympy.symbols("x y z")[:dim]
        x, y = p[0], p[1]
        r = sympy.sqrt(x**2 + y**2)
        pull = gain * (radius(r) - r)
        direction = [(-y + pull * x) / r, (x + pull * y) / r]
        if dim == 3:
            direction.append(gain * (height(r) - p[2]))
        length = sympy.sqrt(sum(c**2 for c in direction))
        m = [c / length for c in direction]
        J = [[sympy.diff(c, s) for s in p] for c in m]
        self._p, self._J = p, J
        self._m_J = sympy.lambdify(p, [m, J], "math", cse=True)
        self._H = None

    def __call__(self, x):
        return self.value_and_jacobian(x)[0]

    def value_and_jacobian(self, x):
        self.calls += 1
        assert x.dtype == np.float64, "the field must never see objects"
        pairs = [self._m_J(*row) for row in x.reshape(-1, self.dim).tolist()]
        m, J = (np.array(values) for values in zip(*pairs, strict=True))
        return m.reshape(x.shape), J.reshape(*x.shape, self.dim)

    def hessian(self, x):
        assert x.dtype == np.float64, "the field must never see objects"
        if self._H is None:
            H = [[[sympy.diff(c, s) for s in self._p] for c in row] for row in self._J]
            self._H = sympy.lambdify(self._p, H, "math")
        H = [self._H(*row) for row in x.reshape(-1, self.dim).tolist()]
        return np.array(H).reshape(*x.shape, self.dim, self.dim)


def spatial_rings():
    """A field around rings of 1 and 2 m at heights of 1 and 2 m."""
    radius = lambda r: r - 2 * (r - 1) * (r - sympy.Rational(3, 2)) * (r - 2)  # noqa: E731
    return CircleField(3, 3.0, radius, height=lambda r: r)


class Rings:
    """A field of unit length around rings about the origin, counter-clockwise.

    Beside the ring of radius R it turns toward it by atan(3 (R - r)).  It has the attributes
    of a `GuidingField` that `fly` wants.
    """

    dim, recipe, seed, sigma = 2, "none", 0, 0.1

    def __init__(self, *radii):
        self.cloud = PointCloud(np.concatenate([radius * UNIT for radius in radii]))
        self.ends = np.empty((0, 2))
        between = [(a + b) / 2.0 for a, b in pairwise(radii)]
        polynomial = np.poly(sorted([*radii, *between]))
        slope = np.polyval(np.polyder(polynomial), radii[0])
        self._pull = -3.0 / slope * polynomial
        self._slope = np.polyder(self._pull)

    def __call__(self, x):
        return self.value_and_jacobian(x)[0]

    def value_and_jacobian(self, x):
        points = np.atleast_2d(x)
        r = np.hypot(*points.T)
        pull = np.polyval(self._pull, r)
        rate = np.polyval(self._slope, r) / (1.0 + pull**2)
        outward = points / r[:, None]
        along = outward[:, ::-1] * [-1.0, 1.0]
        cosine = 1.0 / np.sqrt(1.0 + pull**2)[:, None]
        m = cosine * (along + pull[:, None] * outward)
        normal = cosine * (outward - pull[:, None] * along)
        J = np.einsum("n,ni,nj->nij", rate, normal, outward)
        J -= np.einsum("n,ni,nj->nij", 1.0 / r, normal, along)
        return m.reshape(x.shape), J.reshape(*x.shape, 2)


class Lanes:
    """Leads along y = 0 to rest at x = 3, and back along y = 2 to rest at x = 0."""

    dim = 2

    def __call__(self, x):
        return self.value_and_jacobian(x)[0]

    def value_and_jacobian(self, x):
        points = np.atleast_2d(x)
        back = points[:, 1] > 1.0
        along = np.tanh((np.where(back, 0.0, 3.0) - points[:, 0]) / 0.3)
        across = np.tanh((np.where(back, 2.0, 0.0) - points[:, 1]) / 0.3)
        J = np.zeros((len(points), 2, 2))
        J[:, 0, 0], J[:, 1, 1] = -(1 - along**2) / 0.3, -(1 - across**2) / 0.3
        return np.column_stack([along, across]).reshape(x.shape), J.reshape(*x.shape, 2)


def ring(radius=1.0, center=(0.0, 0.0)):
    return Branch(center + radius * UNIT, LAP * radius, True)


ONE_RING, TWO_RINGS = Rings(1.0), Rings(1.0, 2.0)
RINGS = (ring(1.0), ring(2.0))
LANE_X = np.linspace(0.0, 3.0, 31)
LANES = (
    Branch(np.column_stack([LANE_X, np.zeros(31)]), 3.0, False),
    Branch(np.column_stack([LANE_X[::-1], np.full(31, 2.0)]), 3.0, False),
)


def rms(x):
    return math.sqrt(np.mean(np.square(x)))


def check_refusal(act, message):
    """Asserts that what is done is refused with one line that has this in it."""
    with pytest.raises(ConfigurationError, match=message) as caught:
        act()
    assert "\n" not in str(caught.value)


def differences(function, x, h=1e-6):
    """The derivative of a vector by a vector, by central differences."""
    return np.column_stack(
        [(function(x + e) - function(x - e)) / (2.0 * h) for e in h * np.eye(len(x))]
    )


def order(steps, errors):
    """The exponent of a power law."""
    return np.polyfit(np.log(steps), np.log(errors), 1)[0]


class Flight:
    """A vehicle with `AddGuidance` that hovers at a start, with logs of what it does.

    Entries of its measured state get lost in some intervals; `supervisor` holds the arguments
    of a `BranchSupervisor` beside field and branches, None: there is none.
    """

    def __init__(
        self,
        field=TWO_RINGS,
        start=(1.02, 0.0, 1.0),
        *,
        branches=RINGS,
        supervisor=None,
        lost=None,
        entries=(0, 1, 2),
        seed=0,
        log_period=0.01,
        **options,
    ):
        self.speed = options.setdefault("speed", SPEED)
        builder = DiagramBuilder()
        self.plant = builder.AddNamedSystem("plant", PARAMETERS.MakePlant())
        measured = None
        if lost is not None:
            dropout = builder.AddNamedSystem("dropout", Dropout(12, lost, entries))
            builder.Connect(self.plant.GetOutputPort("state"), dropout.get_input_port())
            measured = dropout.get_output_port()
        self.supervisor = None
        if supervisor is not None:
            self.supervisor = BranchSupervisor(field, branches, **supervisor)
        self.loop = AddGuidance(
            builder,
            field,
            self.plant,
            PARAMETERS,
            supervisor=self.supervisor,
            measured_port=measured,
            **options,
        )
        self.guidance, self.controller = self.loop.guidance, self.loop.controller
        ports = {
            "state": self.plant.GetOutputPort("state"),
            "force": self.loop.GetOutputPort("propeller_force"),
            "command": self.loop.GetOutputPort("velocity_command"),
        }
        if options.get("sensors"):
            ports["estimate"] = self.loop.GetOutputPort("measured_state")
        if self.supervisor is not None:
            for name in ("mode", "branch", "acceleration_feedforward"):
                ports[name] = self.loop.GetOutputPort(name)
        self.logs = {
            name: LogVectorOutput(port, builder, log_period) for name, port in ports.items()
        }
        self.diagram = builder.Build()
        self.simulator = MakeSimulator(self.diagram)
        self.context = self.simulator.get_mutable_context()
        SetHover(self.diagram, self.context, start)
        SetNoiseSeed(self.diagram, self.context, seed)

    def own(self, system):
        return system.GetMyMutableContextFromRoot(self.context)

    def until(self, time):
        self.simulator.AdvanceTo(time)
        return self

    def want(self, branch):
        self.supervisor.SetBranch(self.own(self.supervisor), branch)

    def set_age(self, age):
        """Sets the age of the measurement, where no sensors tell it."""
        port = self.supervisor.GetInputPort("measurement_age")
        port.FixValue(self.own(self.supervisor), [age])

    def set_parameter(self, system, index, entry, value):
        """Past the checks of its own method."""
        parameters = self.own(system).get_mutable_numeric_parameter(index)
        parameters.SetAtIndex(entry, value)

    def times(self):
        return self.logs["state"].FindLog(self.context).sample_times()

    def log(self, name, since=0.0):
        values = self.logs[name].FindLog(self.context).data().T[self.times() > since - 1e-9]
        return values[:, 0] if values.shape[1] == 1 else values

    def history(self):
        """The modes with their branches, in the order in which they were."""
        history = []
        for pair in zip(self.log("mode").tolist(), self.log("branch").tolist(), strict=True):
            if not history or history[-1] != pair:
                history.append(pair)
        return [(Mode(int(mode)).name, int(branch)) for mode, branch in history]

    @property
    def mode(self):
        port = self.supervisor.GetOutputPort("mode")
        return Mode(int(port.Eval(self.own(self.supervisor))[0]))

    @property
    def memory(self):
        vector = self.own(self.supervisor).get_discrete_state(0).CopyToVector()
        return Memory.FromVector(vector)

    @property
    def state(self):
        return self.context.get_continuous_state_vector().CopyToVector()

    def radius(self):
        return math.hypot(*self.state[:2])

    def off_ring(self, radius, since):
        return np.abs(np.hypot(*self.log("state", since)[:, :2].T) - radius).max()

    def speeds(self, since):
        return np.linalg.norm(self.log("state", since)[:, VELOCITY], axis=1)

    def altitudes(self, since=0.0):
        return self.log("state", since)[:, 2]

    def steps_of_command(self, since):
        return np.linalg.norm(np.diff(self.log("command", since), axis=0), axis=1)

    def excess_force(self, since):
        return np.abs(self.log("force", since) - PARAMETERS.hover_force).max()

    def estimation_error(self, since):
        error = self.log("estimate", since) - self.log("state", since)
        return np.abs(error[:, POSITION]).max()

    def assert_follows(self, radius, since):
        """It flies a ring at its speed: undisturbed it keeps 2 mm and 1 %."""
        np.testing.assert_allclose(self.speeds(since), self.speed, rtol=0.02)
        assert self.off_ring(radius, since) < 0.005
        assert np.abs(self.altitudes(since) - 1.0).max() < 0.01
