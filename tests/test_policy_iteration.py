"""policy_iteration.py: the three tables of §4.4, first policies, ties."""

import policy_iteration as script
import pytest
from known_mdps import go, q_row, refused, run, tables


def test_the_lectures_three_tables(tmp_path, capsys):
    result = run(script, tmp_path)
    V, Q, policy = tables(capsys.readouterr().out)
    assert V == [["9", "1", "1"], ["11", "1", "4"], ["11", "1", "4"]]
    assert Q == [q_row(1, 11, 1, 1, 9, 9, 3.4), *2 * [q_row(1, 11, 1, 4, 10.2, 11, 4)]]
    assert policy == [["a2", "a1", "a1"], ["a1", "a1", "a2"], ["a1", "a1", "a2"]]
    assert result["values"] == pytest.approx({"s0": 11, "s1": 1, "s2": 4})


def test_first_policies(tmp_path):
    found = run(script, tmp_path, initial_policy="s2=a2 s1=a1 s0=a2")
    assert found["values"]["s0"] == pytest.approx(11)
    for policy in ("s0=a2 s1=a1", "s0=a2 s1=a1 s2=a1 s2=a9"):
        refused(script, tmp_path, initial_policy=policy)
    refused(script, tmp_path, max_iterations=1)
    model = {"s": {"stay": [go("s", -1)], "out": [go("goal", -9)]}}
    refused(script, tmp_path, model, initial_policy="s=stay")
    assert run(script, tmp_path, model)["values"] == {"s": -9}  # it begins with one that ends
    model["s"]["idle"] = [go("s")]  # worth 0, though from "out" it only ties: Q = 0 + V(s) = -9
    assert run(script, tmp_path, model, initial_policy="s=out")["values"] == {"s": 0}
    chain = {str(i): {"": [go(str(i + 1) if i < 2999 else "goal", i == 2999)]} for i in range(3000)}
    assert run(script, tmp_path, chain)["values"]["0"] == pytest.approx(1)  # not by BiCGSTAB


@pytest.mark.parametrize("gain", [0, 1e-16, 1.5e-9, 1e-8])
def test_ties_come_to_rest(gain, tmp_path):
    """An action that gains less than ties may differ by is no reason to go on, nor to and fro."""
    model = {"s": {"a": [go("t")], "b": [go("t", gain)]},
             "t": {"back": [go("s", -gain)], "a": [go("goal", 1)], "b": [go("goal", 1 + gain)]}}
    found = run(script, tmp_path, model, initial_policy="s=b t=a")  # fmt: skip
    assert found["values"]["t"] == pytest.approx(1 + gain, abs=3e-9) and found["iterations"] <= 3
    assert found["policy"]["t"] != "back"
