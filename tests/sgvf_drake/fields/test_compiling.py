"""What numba costs a process: when it is imported, and when it compiles."""

import os
import subprocess
import sys

from numba.core.registry import CPUDispatcher
import numpy as np

from sgvf_drake.compiling import digest
from sgvf_drake.fields.compiled.evaluation import SOURCES, evaluate

CALLER = """\
import callee
from sgvf_drake.compiling import digest, kernel

def make(sources):
    @kernel
    def answer(x):
        sources
        return callee.part_of_it(x)
    return answer

answer = make(digest(callee))
print(answer(20.0), sum(answer.stats.cache_hits.values()))
"""
CALLEE = """\
from sgvf_drake.compiling import part

@part
def part_of_it(x):
    return x + {}
"""


def output_of(arguments, folder, **environment):
    """What a fresh process prints."""
    run = subprocess.run(
        [sys.executable, *arguments],
        capture_output=True,
        text=True,
        check=True,
        cwd=folder,
        env=os.environ | environment,
    )
    return run.stdout.split()


def compiled_functions(function, found):
    """A function in Python and those that are compiled into it, by their names."""
    for name in function.__code__.co_names:
        callee = function.__globals__.get(name)
        if isinstance(callee, CPUDispatcher) and callee.py_func not in found:
            found.add(callee.py_func)
            compiled_functions(callee.py_func, found)
    return found


def test_a_field_is_loaded_and_evaluated_without_numba(tmp_path, make_field):
    make_field("robust").save(tmp_path / "field.safetensors")
    code = (
        "import sys, numpy as np, sgvf_drake\n"
        "field = sgvf_drake.load_field('field.safetensors')\n"
        "field.value_and_jacobian(np.zeros(2))\n"
        "print('numba' in sys.modules)\n"
        "field.compiled()\n"
        "print('numba' in sys.modules)"
    )
    assert output_of(["-c", code], tmp_path) == ["False", "True"]


def test_a_second_process_takes_the_code_from_the_cache(tmp_path, make_field):
    field = make_field("robust")
    point = np.array([3.0, 4.0])
    # At the latest now it is compiled, and cached.
    expected = field.compiled().evaluate(point)
    field.save(tmp_path / "field.safetensors")
    code = (
        "import numpy as np, sgvf_drake\n"
        "from sgvf_drake.fields.compiled.evaluation import evaluate\n"
        "field = sgvf_drake.load_field('field.safetensors')\n"
        "flat = field.compiled().evaluate((3.0, 4.0))\n"
        "print(sum(evaluate.stats.cache_hits.values()), *map(float, flat))"
    )
    hits, *flat = output_of(["-c", code], tmp_path)
    assert hits == "1"
    np.testing.assert_array_equal(np.array(flat, dtype=float), expected)


def test_the_cache_notices_a_change_in_what_the_kernel_calls(tmp_path):
    (tmp_path / "caller.py").write_text(CALLER)
    answers = []
    for number in (1, 1, 22):
        (tmp_path / "callee.py").write_text(CALLEE.format(number))
        answers.append(output_of(["-B", "caller.py"], tmp_path))
    assert answers == [["21.0", "0"], ["21.0", "1"], ["42.0", "0"]]


def test_everything_compiled_is_in_the_key_of_the_cache():
    functions = compiled_functions(evaluate.py_func, set())
    assert len(functions) > 10
    sources = {module.__name__ for module in SOURCES}
    # What stands in the file of the kernel is in the key anyway.
    assert {f.__module__ for f in functions} <= sources | {evaluate.py_func.__module__}
    (enclosed,) = evaluate.py_func.__closure__
    assert enclosed.cell_contents == digest(*SOURCES)


def test_where_nothing_can_be_written_it_is_compiled_all_the_same(tmp_path):
    (tmp_path / "__pycache__").write_text("a file, so that this is no folder to write to")
    (tmp_path / "caller.py").write_text(CALLER)
    (tmp_path / "callee.py").write_text(CALLEE.format(1))
    nowhere = str(tmp_path / "__pycache__")
    found = output_of(["-B", "caller.py"], tmp_path, HOME=nowhere, XDG_CACHE_HOME=nowhere)
    assert found == ["21.0", "0"]
