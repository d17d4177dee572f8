"""linear_program.py: the program of Equation 27 as printed, and its optimum."""

import linear_program as script
import numpy as np
import pytest
from known_mdps import brute, go, run

PROGRAM = """min  V(s0) + V(s1) + V(s2)  subject to
V(s0) ≥ 1·[10 + V(s1)]
V(s0) ≥ 0.6·[10 + V(s1)] + 0.4·[5 + V(s2)]
V(s1) ≥ 1·[1 + 0]
V(s2) ≥ 1·[1 + 0]
V(s2) ≥ 0.7·[1 + 0] + 0.3·[0 + V(s0)]
"""


def test_the_lectures_mdp(tmp_path, capsys):
    assert run(script, tmp_path)["values"] == pytest.approx({"s0": 11, "s1": 1, "s2": 4})
    assert capsys.readouterr().out.startswith(PROGRAM + "\n")  # here nothing idles
    assert run(script, tmp_path, {"s": {"": [go("s")]}})["values"] == {"s": 0}
    assert "V(s) ≥ 0\n" in capsys.readouterr().out


def test_actions_that_differ_little_are_told_apart():
    rng = np.random.default_rng(0)
    for _ in range(20):
        model = {s: {a: [go(str(rng.integers(5)), 1 + 5e-8 * rng.random(), p) for p in (0.25, 0.75)]
                     for a in "abc"} for s in "01234"}  # fmt: skip
        V, _ = script.linear_program(*script.arrays(model), 0.95)
        assert V == pytest.approx(brute(model, 0.95), abs=1e-9)
