"""The time of what is done, without that of compiling."""

from types import SimpleNamespace

from numba.core import event

from sgvf_drake import compiling


def test_what_is_compiled_is_left_out(monkeypatch):
    now = [0.0]
    clocks = SimpleNamespace(perf_counter=lambda: now[0], process_time=lambda: 0.5 * now[0])
    monkeypatch.setattr(compiling, "time", clocks)

    def take(seconds):
        now[0] += seconds

    with compiling.timed() as watch:
        take(1.0)
        with event.trigger_event("numba:compile"):
            take(10.0)
            # What it calls is compiled with it.
            with event.trigger_event("numba:compile"):
                take(20.0)
            take(40.0)
        take(2.0)
    take(100.0)
    assert (watch.wall_s, watch.cpu_s) == (3.0, 1.5)
