"""The port diagram in the docstring of every exported system tells the ports it has."""

import inspect
import re

import numpy as np
from pydrake.common.cpp_template import TemplateClass
from pydrake.common.yaml import yaml_load
from pydrake.geometry import FrameId
from pydrake.systems.framework import Diagram, LeafSystem, LeafSystem_
import pytest

from sgvf_drake.fields import GaussianMixture
from sgvf_drake.lyapunov import LyapunovFunction
import systems
from systems import (
    Branch,
    BranchSupervisor,
    Dropout,
    FlightTrail,
    GuidanceSystem,
    KinematicGuidance,
    LyapunovMonitor,
    MakeMeshcat,
    MotionCapture,
    QuadrotorGeometry,
    Se3Controller,
    SensorParameters,
    StateEstimator,
)

DIAGRAM = re.compile(r"^\.\. pydrake_system::\n\n((?:    .*\n|\n)+)", re.MULTILINE)

# An instance of each exported system; the diagram is that of any of them.
MAKERS = {
    "BranchSupervisor": lambda field: BranchSupervisor(
        field, (Branch(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), 3.4, True),)
    ),
    "Dropout": lambda _: Dropout(12, [(1.0, 2.0)], [0]),
    "FlightTrail": lambda _: FlightTrail(MakeMeshcat(port=0)),
    "GuidanceSystem": lambda field: GuidanceSystem(field),
    "KinematicGuidance": lambda field: KinematicGuidance(field, 3),
    "LyapunovMonitor": lambda field: LyapunovMonitor(
        LyapunovFunction(GaussianMixture(field.cloud.points, 0.4)), 3
    ),
    "MotionCapture": lambda _: MotionCapture(SensorParameters()),
    "QuadrotorGeometry": lambda _: QuadrotorGeometry(FrameId.get_new_id()),
    "Se3Controller": lambda _: Se3Controller(),
    "StateEstimator": lambda _: StateEstimator(0.01),
}


def exported_systems():
    """The classes of systems among the exported names; those of templates in float."""
    found = {}
    for name in systems.__all__:
        value = getattr(systems, name)
        if isinstance(value, TemplateClass):
            value, name = value[None], name.removesuffix("_")
        if inspect.isclass(value) and issubclass(value, LeafSystem | Diagram):
            found[name] = value
    return found


def read_diagram(system_class):
    """The diagram of a class as a mapping, or None."""
    match = DIAGRAM.search(inspect.cleandoc(system_class.__doc__ or "") + "\n")
    return None if match is None else yaml_load(data=inspect.cleandoc(match[1]))


def port_names(system):
    return {
        "input_ports": [
            system.get_input_port(i).get_name() for i in range(system.num_input_ports())
        ],
        "output_ports": [
            system.get_output_port(i).get_name() for i in range(system.num_output_ports())
        ],
    }


def check_diagram(system, diagram):
    expected = {"input_ports": [], "output_ports": [], **diagram}
    del expected["name"]
    assert port_names(system) == expected


def test_systems_are_found():
    # Of each kind: from a template, a plain leaf system, a diagram.
    assert {"GuidanceSystem", "FlightTrail", "MotionCapture"} <= set(exported_systems())
    assert set(MAKERS) == set(exported_systems())


@pytest.mark.parametrize("name", exported_systems())
def test_docstring_opens_with_a_diagram_of_the_systems_name(name):
    system_class = exported_systems()[name]
    diagram = read_diagram(system_class)
    assert diagram is not None, f"{name} has no port diagram in its docstring"
    assert diagram["name"] == name
    # The summary is one line, and the diagram comes next.
    lines = inspect.cleandoc(system_class.__doc__).splitlines()
    assert lines[1:3] == ["", ".. pydrake_system::"]


@pytest.mark.parametrize("name", exported_systems())
def test_ports_are_those_of_the_diagram_in_order(name, make_field):
    assert name in MAKERS, f"add an instance of {name} to MAKERS"
    system = MAKERS[name](make_field("exact"))
    diagram = read_diagram(exported_systems()[name])
    check_diagram(system, diagram)
    if hasattr(systems, f"{name}_"):
        check_diagram(system.ToAutoDiffXd(), diagram)


def test_a_system_without_a_diagram_is_noticed():
    class Bare(LeafSystem):
        """Has ports, and says nothing of them."""

    assert read_diagram(Bare) is None


def test_a_wrong_diagram_is_noticed():
    class Wrong(LeafSystem):
        """Names a port that it does not have.

        .. pydrake_system::

            name: Wrong
            input_ports:
            - state
            - speed
        """

        def __init__(self):
            LeafSystem_[float].__init__(self)
            self.DeclareVectorInputPort("speed", 1)
            self.DeclareVectorInputPort("state", 12)

    diagram = read_diagram(Wrong)
    assert diagram == {"name": "Wrong", "input_ports": ["state", "speed"]}
    with pytest.raises(AssertionError):
        check_diagram(Wrong(), diagram)
