"""exhaustive_search.py: the three policies of §4.2, the warm start, policies that are many."""

import exhaustive_search as script
import numpy as np
import pytest
from known_mdps import go, refused, run


def search(model, *start):
    """π, V and [(V of the start, sweeps, sweeps from 0), ...]."""
    return script.exhaustive_search(*script.arrays(model), np.array(start), script.Args())


def test_the_lectures_three_policies(tmp_path, capsys):
    result = run(script, tmp_path)
    assert result["values"] == {"s0": 11, "s1": 1, "s2": None} and result["iterations"] == 3
    assert result["policy"] == {"s0": "a1", "s1": "a1"}
    values, sweeps, from_0 = np.transpose(search(script.FIGURE_5, 1, 0, 0)[2])
    assert values == pytest.approx([11, 9, 111 / 11]) and sum(sweeps) < sum(from_0)
    out = capsys.readouterr().out
    assert f" {sum(sweeps):g} sweeps, {sum(from_0):g} from V = 0\n" in out
    assert all(f"; s0={π}\n" in out for π in ("a1 s1=a1", "a2 s1=a1 s2=a1", "a2 s1=a1 s2=a2"))


def test_the_warm_start():
    """What is in common is not worked out again; nothing leaks into a loop without rewards."""
    model = {"s": {"a": [go("t")], "b": [go("t", 9)]},
             "t": {"on": [go("t", 0, 0.9), go("goal", 1, 0.1)]}}  # fmt: skip
    (_, _, cold), (value, warm, cold_too) = search(model, 1, 0)[2]
    assert value == pytest.approx(9 + 1) and warm <= 3 and min(cold, cold_too) > 200
    model = {"s": {"on": [go("t", 4)]}, "t": {"out": [go("goal", 8)], "stay": [go("t")]}}
    assert [value for value, *_ in search(model, 0.25, 0.75)[2]] == [9, 1]  # from two starts


def test_policies_that_differ_only_where_they_never_come_are_one(tmp_path):
    """A tree of 63 nodes: 2^63 choices of actions, of which 64 paths are policies."""
    model = {str(n): {way: [go(str(2 * n + k) if n < 32 else "goal", n)]
                      for k, way in enumerate("lr")} for n in range(1, 64)}  # fmt: skip
    found = run(script, tmp_path, model, max_policies=64)
    assert found["iterations"] == 64 and found["values"]["1"] == 1 + 3 + 7 + 15 + 31 + 63
    refused(script, tmp_path, model, max_policies=63)
