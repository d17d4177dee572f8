"""policy_evaluation.py: §3.2 as printed, policies that never end; bad input of the five scripts."""

import numpy as np
import policy_evaluation as script
import pytest
from known_mdps import SCRIPTS, dense, go, random_model, refused, run, tables

ONE, S0 = "1·[1 + 0] = 1", "0.6·[10 + {}] + 0.4·[5 + {}] = {}"
S2 = "0.7·[1 + 0] + 0.3·[0 + {}] = {}"
LECTURE = [  # V(s0) and V(s2), Equation 3 of s0, i = 1, 2, 3 of Algorithm 1; π1, π2 and π3
    ("s0=a1 s1=a1", 11, None, "1·[10 + V(s1)] = 11", [
        ["1·[10 + 0] = 10", ONE], ["1·[10 + 1] = 11", ONE], ["1·[10 + 1] = 11", ONE]]),
    ("s0=a2 s1=a1 s2=a1", 9, 1, "0.6·[10 + V(s1)] + 0.4·[5 + V(s2)] = 9", [
        [S0.format(0, 0, 8), ONE, ONE], *2 * [[S0.format(1, 1, 9), ONE, ONE]]]),
    ("s0=a2 s1=a1 s2=a2", 111 / 11, 41 / 11, "0.6·[10 + V(s1)] + 0.4·[5 + V(s2)] = 111/11", [
        [S0.format(0, 0, 8), ONE, S2.format(0, 0.7)],
        [S0.format(1, 0.7, 8.88), ONE, S2.format(8, 3.1)],
        [S0.format(1, 3.1, 9.84), ONE, S2.format(8.88, 3.36)]])]  # fmt: skip


class TestPolicies:
    def test_the_lectures_three(self, tmp_path, capsys):
        run(script, tmp_path)
        printed = capsys.readouterr().out
        assert "V(s2) = 0.7·[1 + 0] + 0.3·[0 + V(s0)] = 41/11" in printed
        assert [table[1:4] for table in tables(printed)] == [rows for *_, rows in LECTURE]
        for policy, v0, v2, equation, _ in LECTURE:
            assert f"V(s0) = {equation}\n" in printed
            result = run(script, tmp_path, policy=policy)
            assert result["values"] == pytest.approx({"s0": v0, "s1": 1, "s2": v2}, abs=1e-10)
            assert result["policy"] == dict(item.split("=") for item in policy.split())
        run(script, tmp_path, policy="s0=a2 s1=a1 s2=a2", discount=0.9)
        equation = "V(s0) = 0.6·[10 + 0.9·V(s1)] + 0.4·[5 + 0.9·V(s2)] = 21980/2257\n"
        assert equation in capsys.readouterr().out  # 8.792 / (1 - 0.0972)

    @pytest.mark.parametrize("discount", [0, 0.5, 0.9, 1])
    def test_random_ones_against_a_dense_system(self, discount, tmp_path):
        for seed in range(20):
            rng = np.random.default_rng(seed)
            model = random_model(rng, proper=discount == 1)
            policy = {s: str(rng.choice(list(model[s]))) for s in model}
            text = " ".join(map("=".join, policy.items()))
            values = run(script, tmp_path, model, discount=discount, policy=text)["values"]
            V, reached = np.array(list(values.values()), float), ["s0"]  # null becomes NaN
            for s in reached:  # it grows
                ways = model[s][policy[s]]
                reached += {n for p, n, _, ends in ways if p and not ends} - {*reached}
            assert {s for s in values if values[s] is not None} == {*reached}
            np.testing.assert_allclose(V, dense(model, policy, discount) + 0 * V, 1e-8, 1e-6)

    def test_that_never_end(self, tmp_path):
        model = {"s": {"on": [go("t", 4, 0.5), go("goal", 0, 0.5)]}, "v": {"gain": [go("v", 3)]},
                 "t": {"on": [go("u")], "out": [go("goal")]},
                 "u": {"free": [go("t")], "dear": [go("t", -1)]}}  # fmt: skip
        free = run(script, tmp_path, model, policy="s=on t=on u=free")  # then for ever for nothing
        assert free["values"] == {"s": 2, "t": 0, "u": 0, "v": None}
        assert run(script, tmp_path, model, policy="s=on t=out v=gain")["values"]["s"] == 2
        dear = {"model": model, "policy": "s=on t=on u=dear"}
        assert run(script, tmp_path, **dear, discount=0.5)["values"]["t"] == pytest.approx(-2 / 3)
        refused(script, tmp_path, **dear)

    def test_from_the_starts_of_gymnasium(self, tmp_path):
        values = run(script, tmp_path, env_id="Taxi-v4", discount=0.9)["values"]  # 0 is no start
        assert values["0"] is None and values["1"] == pytest.approx(-10)  # south for ever

    @pytest.mark.parametrize("settings", [
        {"policy": "s0=a1 s1=a1 s2=a9"}, {"policy": "s0=a2 s1=a1"}, {"max_iterations": 2},
        {"discount": 1.1}, {"discount": float("nan")}, {"env_id": "CartPole-v1"}, {"env_id": "No"},
        {"env_id": "FrozenLake-v1", "env_kwargs": "map_name=9x9"}])  # fmt: skip
    def test_bad_settings(self, settings, tmp_path):
        refused(script, tmp_path, **settings)


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.__name__)
class TestEveryScript:
    @pytest.mark.parametrize("transitions", [
        [go("goal", 1, 0.9)], [go("goal", 1, 1.5), go("goal", 1, -0.5)], [go("nowhere")],
        [go("goal", float("nan"))], [go("goal", float("inf"))], [go("goal", 10**400)],
        [[1, "s", 0, "false"]], [[1, "s", 0, 2]], [go("goal", [1])],
        [go("goal", 1, float("nan")), go("goal")], [go("goal", 1, "1")], [go("goal")[:3]], [], 7])
    def test_bad_models(self, script, transitions, tmp_path):  # fmt: skip
        model = {"s": {"a": [go("goal")]}, "here": {"this": transitions}}
        assert "here" in (line := refused(script, tmp_path, model)) and "this" in line

    def test_large_values_whose_last_digits_alternate(self, script, tmp_path):
        model = {"s": {"on": [go("t", 1e6)]}, "t": {"on": [go("s", -1e6)]}}
        assert run(script, tmp_path, model, discount=0.9)["values"]["s"] == pytest.approx(1e6 / 1.9)

    def test_no_model(self, script, tmp_path):
        refused(script, tmp_path, {"s": {"a": [go("here")]}, "here": {}})
        text = '\ufeff{"s": {"a": [[1, "goal", 0, true]]}, "goal": {}}'  # \ufeff: from Windows
        found = run(script, tmp_path, text)  # "goal": the lecture's s_G
        assert found["values"] == {"s": 0}
        for text in ("", "{}", "[]", "[" * 100_000, '{"s": 3}'):
            refused(script, tmp_path, text)

    def test_command_line(self, script, command_line, tmp_path):
        done = command_line(f"{script.__name__}.py")
        printed = " ".join(done.stdout.split())
        assert (done.returncode, done.stderr) == (0, "") and "s0 11 a1" in printed
        (tmp_path / "bad.json").write_text('{"s": {"a": [[1, "goal", NaN, true]]}}')
        done = command_line(f"{script.__name__}.py", "--model=bad.json", "--output-json=out.json")
        assert done.returncode == 1 and done.stderr.count("\n") == 1 and not done.stdout
        assert [path.name for path in tmp_path.iterdir()] == ["bad.json"]
