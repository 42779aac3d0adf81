"""What the benchmark of the steps says of a log, of looks at a process, and of a process at work."""

import subprocess
import sys
import time

from scripts.benchmarks import steps as bench


def test_steps_within_steps_are_told_apart(tmp_path):
    stamp = "2026-01-02 03:04:{:06.3f} INFO {}"
    lines = [
        (1, "selection: nothing to choose"),
        (2, "matches: started"),
        (3, "features: started"),
        (5, "features: finished in 2.0 s"),
        (9, "matches: finished in 7.0 s"),
        (10, "mapping: started"),
    ]
    (tmp_path / "log.txt").write_text("".join(stamp.format(t, line).replace(".", ",", 1) + "\n" for t, line in lines))
    steps = bench.steps_of(tmp_path / "log.txt")
    begin_s = steps[1][1]
    assert [(name, a - begin_s, b - begin_s) for name, a, b in steps] == [("features", 1, 3), ("matches", 0, 7)]
    # before them; in the inner one with one thread, then with two; in the outer one
    looks = [
        bench.Look(clock_s=begin_s + t, busy=busy, processor_s=spent)
        for t, busy, spent in ((-1, 1, 0), (-0.5, 1, 0.5), (1.5, 1, 1.5), (2.5, 2, 3.5), (6, 3, 8.5))
    ]
    found = bench.shared_out(looks, steps)
    assert found["between"] == {
        "clock_s": 0.5, "processor_s": 0.5, "one_thread_s": 0.5, "two_idle_cores_s": 0.5,
    }  # fmt: skip
    assert found["features"] == {
        "clock_s": 3.0, "processor_s": 3.0, "one_thread_s": 1.0, "two_idle_cores_s": 2.0,
    }  # fmt: skip
    assert found["matches"] == {
        "clock_s": 3.5, "processor_s": 5.0, "one_thread_s": 0.0, "two_idle_cores_s": 2.5,
    }  # fmt: skip


def test_a_process_is_seen_at_work_and_what_it_began():
    spinning = "while True: pass"
    code = f"import subprocess, sys\nsubprocess.Popen([sys.executable, '-c', {spinning!r}])\n{spinning}"
    with subprocess.Popen([sys.executable, "-c", code]) as run:
        spent = {}
        try:
            for _ in range(100):
                one = bench.look(run.pid, spent)
                if one.busy == 2 and len(spent) == 2:
                    break
                time.sleep(0.05)
            assert one.busy == 2 and len(spent) == 2
            time.sleep(0.3)
            assert bench.look(run.pid, spent).processor_s > 0
        finally:
            for pid in list(bench.processes(run.pid))[::-1]:
                subprocess.run(["kill", "-9", str(pid)], check=True)
