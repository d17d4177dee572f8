"""Policy evaluation: the lecture's three policies (§3.2), improper policies, and the bad input of all five scripts."""

import json
import re
from fractions import Fraction

import exhaustive_search
import numpy as np
import policy_evaluation as script
import policy_iteration
import pytest
from known_mdps import BETTER_STAY, SCRIPTS, dense_values, random_model, run, sparse_mdp, tables, written
from scipy import sparse

ONE = "1·[1 + 0] = 1"
LECTURE = {  # policy: (linear system, solution, the table of Algorithm 1 to i = 3)
    "s0=a1 s1=a1": (
        ["V(sG) = 0", "V(s1) = 1·[1 + V(sG)]", "V(s0) = 1·[10 + V(s1)]"],
        {"sG": 0, "s1": 1, "s0": 11},
        [["0", "0", "0", "0"], *([str(i), f"1·[10 + {v}] = {10 + v}", ONE, "0"] for i, v in ((1, 0), (2, 1), (3, 1)))],
    ),
    "s0=a2 s1=a1 s2=a1": (
        ["V(sG) = 0", "V(s2) = 1·[1 + V(sG)]", "V(s1) = 1·[1 + V(sG)]", "V(s0) = 0.6·[10 + V(s1)] + 0.4·[5 + V(s2)]"],
        {"sG": 0, "s2": 1, "s1": 1, "s0": 9},
        [
            ["0", "0", "0", "0", "0"],
            ["1", "0.6·[10 + 0] + 0.4·[5 + 0] = 8", ONE, ONE, "0"],
            ["2", "0.6·[10 + 1] + 0.4·[5 + 1] = 9", ONE, ONE, "0"],
            ["3", "0.6·[10 + 1] + 0.4·[5 + 1] = 9", ONE, ONE, "0"],
        ],
    ),
    "s0=a2 s1=a1 s2=a2": (
        [
            "V(sG) = 0",
            "V(s2) = 0.7·[1 + V(sG)] + 0.3·[0 + V(s0)]",
            "V(s1) = 1·[1 + V(sG)]",
            "V(s0) = 0.6·[10 + V(s1)] + 0.4·[5 + V(s2)]",
        ],
        {"sG": 0, "s2": Fraction(41, 11), "s1": 1, "s0": Fraction(111, 11)},
        [
            ["0", "0", "0", "0", "0"],
            ["1", "0.6·[10 + 0] + 0.4·[5 + 0] = 8", ONE, "0.7·[1 + 0] + 0.3·[0 + 0] = 0.7", "0"],
            ["2", "0.6·[10 + 1] + 0.4·[5 + 0.7] = 8.88", ONE, "0.7·[1 + 0] + 0.3·[0 + 8] = 3.1", "0"],
            ["3", "0.6·[10 + 1] + 0.4·[5 + 3.1] = 9.84", ONE, "0.7·[1 + 0] + 0.3·[0 + 8.88] = 3.36", "0"],
        ],
    ),
}


def check_lecture(out, policy):
    """One policy's output against the lecture: system, fractions, table."""
    system, solution, rows = LECTURE[policy]
    printed = re.search(r"Linear system.*:\n((?:  .*\n)+)", out).group(1)
    assert [line.strip() for line in printed.splitlines()] == system
    assert "Solution: " + ", ".join(f"V({state}) = {value}" for state, value in solution.items()) in out
    assert tables(out)[0][1:5] == rows


def test_the_lectures_three_policies_as_printed(monkeypatch, capsys):
    code, out, err = run(script, monkeypatch, capsys)
    assert (code, err) == (0, "")
    parts = re.split(r"^π[¹²³]: ", out, flags=re.MULTILINE)[1:]
    assert [part.splitlines()[0] for part in parts] == list(LECTURE)
    for part, policy in zip(parts, LECTURE, strict=True):
        check_lecture(part, policy)
    assert "V(s2) is undefined: the policy does not reach s2." in parts[0]
    assert not any("undefined" in part for part in parts[1:])
    assert "s0 --a2--> s1 (probability 0.6, reward 10), s2 (probability 0.4, reward 5)" in parts[1]


@pytest.mark.parametrize("policy", LECTURE)
def test_a_policy_of_ones_own_as_printed_and_as_json(policy, monkeypatch, capsys, tmp_path):
    _, out, _ = run(script, monkeypatch, capsys, "--policy", policy, "--output-json", tmp_path / "out.json")
    check_lecture(out, policy)
    result = json.loads((tmp_path / "out.json").read_text(encoding="utf-8"))
    solution = LECTURE[policy][1]
    defined = {state: value for state, value in result["values"].items() if value is not None}
    assert defined == pytest.approx({state: float(value) for state, value in solution.items()}, abs=1e-12)
    if policy.endswith("s2=a2"):
        steps = [entry["values"]["s0"] for entry in result["history"][:4]]
        assert steps == pytest.approx([0, 8, 8.88, 9.84], abs=1e-12)
        assert result["history"][3]["values"]["s2"] == pytest.approx(3.364, abs=1e-12)  # printed 3.36
    assert result["policy"] == dict(item.split("=") for item in policy.split())


def test_the_three_policies_as_json_and_figure(monkeypatch, capsys, tmp_path):
    run(script, monkeypatch, capsys, "--output-json", tmp_path / "out.json", "--figure", tmp_path / "figure.png")
    results = json.loads((tmp_path / "out.json").read_text(encoding="utf-8"))
    assert [result["values"]["s0"] for result in results] == pytest.approx([11, 9, 111 / 11], abs=1e-12)
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")


def test_direct_iterative_exact_and_dense_solutions_agree():
    for seed in range(200):
        rng = np.random.default_rng(seed)
        proper = seed % 2 == 0
        model, discount = random_model(rng, proper), 1.0 if proper else 0.9
        mdp = script.mdp_from_json(model)
        policy = script.parse_policy(mdp, "random", rng)
        solution = script.policy_evaluation(mdp, policy, discount, 1e-12, 100_000)
        reached = ~np.isnan(solution.V)
        chosen = {state: mdp.actions[policy[s]] for s, state in enumerate(model["transitions"])}
        dense = dense_values(model, chosen, discount)
        expected = np.array([dense.get(state, 0) for state in mdp.states])
        np.testing.assert_allclose(solution.V[reached], expected[reached], atol=1e-10)
        np.testing.assert_allclose(solution.history[-1]["values"][reached], expected[reached], atol=1e-8)
        exact = script.solve_exactly(mdp, policy, reached & ~mdp.terminal, discount)
        assert all(float(value) == pytest.approx(expected[s], abs=1e-10) for s, value in exact.items())


def test_fractions_are_the_ones_that_the_floats_stand_for():
    fractions = [Fraction(3, 5), Fraction(1, 3), Fraction("1e-12"), Fraction(-5, 2)]
    assert [script.simplest(x) for x in (0.6, 1 / 3, 1e-12, -2.5)] == fractions


def test_large_systems_direct_and_iterative_agree(monkeypatch):
    mdp = sparse_mdp(script, np.random.default_rng(0), 20_000)
    P, R = script.policy_system(mdp, mdp.first_row, ~mdp.terminal)
    with monkeypatch.context() as context:
        context.setattr(script.linalg, "spsolve", None)  # which would fill in: it must not come to that
        V = script.solve_policy(P, R, 0.95, np.zeros(20_000))
    iterated, _, _ = script.iterative_policy_evaluation(P, R, 0.95, np.zeros(20_000), 1e-12, 10_000)
    np.testing.assert_allclose(V, iterated, atol=1e-8)
    # a long chain, without discount: nothing for BiCGSTAB, but no fill-in either
    size = 5000
    chain = sparse.diags_array(np.ones(size - 1), offsets=1, shape=(size, size)).tocsr()
    V = script.solve_policy(chain, np.ones(size), 1.0, np.zeros(size))
    np.testing.assert_allclose(V, np.arange(size, 0, -1), atol=1e-8)


def test_a_policy_that_never_ends(monkeypatch, capsys, tmp_path):
    path = written(tmp_path / "mdp.json", BETTER_STAY)
    code, out, err = run(script, monkeypatch, capsys, "--mdp", path, "--policy", "s=step t=back")
    assert (code, err) == (0, "") and "V(s) = 0   (it never leaves, and expects a reward of 0)" in out
    model = {"start": "s", "terminal": ["goal"], "transitions": {
        "s": {"on": [[0.5, "t", 4], [0.5, "goal", 0]]},
        "t": {"on": [[1, "u", 0]], "out": [[1, "goal", 0]]},
        "u": {"back": [[1, "t", 0]], "costly": [[1, "t", -1]]},
        "v": {"free": [[1, "v", 3]]},
    }}  # fmt: skip
    path = written(tmp_path / "mdp.json", model)
    code, out, _ = run(script, monkeypatch, capsys, "--mdp", path, "--policy", "s=on t=on u=back")
    assert code == 0 and "V(s) = 2\n" in out  # 4 with probability 0.5, then nothing for ever
    code, _, err = run(script, monkeypatch, capsys, "--mdp", path, "--policy", "s=on t=on u=costly")
    why = "it can be caught for ever in t, u, where a reward is not 0"
    assert code == 2 and err == f"error: the policy has no finite value at discount 1: {why}\n"
    discounted = ["--mdp", path, "--policy", "s=on t=on u=costly", "--discount", 0.5]
    assert run(script, monkeypatch, capsys, *discounted)[0] == 0
    # a loop that the policy does not reach does no harm
    assert run(script, monkeypatch, capsys, "--mdp", path, "--policy", "s=on t=out v=free")[0] == 0


@pytest.mark.parametrize("text, message", [
    ("s9=a1", "policy: 's9' is no state"),
    ("s0=a9", "policy: state s0 has no action 'a9'"),
    ("s0", "policy: 's0' is not state=action"),
    ("s0=a1 s0=a2", "policy: state s0 occurs twice"),
    ("s0=a1", "the policy reaches s1 but names no action there"),
    ("sG=a1", "policy: state sG has no action 'a1'"),
    ("s0=", "policy: state s0 has no action ''"),
    ("nowhere.json", "nowhere.json"),
])  # fmt: skip
def test_bad_policies(text, message, monkeypatch, capsys):
    code, _, err = run(script, monkeypatch, capsys, "--policy", text)
    assert code == 2 and message in err and err.count("\n") == 1


@pytest.mark.filterwarnings("error")
def test_a_saved_policy_is_evaluated(monkeypatch, capsys, tmp_path):
    run(exhaustive_search, monkeypatch, capsys, "--output-json", tmp_path / "best.json")
    code, out, _ = run(script, monkeypatch, capsys, "--policy", tmp_path / "best.json")
    assert code == 0 and "V(s0) = 11\n" in out
    (tmp_path / "empty.json").write_text("[]", encoding="utf-8")
    code, _, err = run(script, monkeypatch, capsys, "--policy", tmp_path / "empty.json")
    assert code == 2 and 'has no "policy"' in err


def model_text(old="", new=""):
    """The lecture's MDP as JSON, with one piece of it spoilt."""
    text = json.dumps(script.FIGURE_5)
    assert old in text
    return text.replace(old, new, 1)


BAD_MODELS = [
    (model_text("0.6", "0.5"), r"state s0, action a2: the probabilities sum to 0\.9, not to 1"),
    (model_text("0.6", "0"), r"state s0, action a2: the probabilities sum to 0\.4, not to 1"),
    (model_text("0.6", "-0.6"), r"state s0, action a2: -0\.6 is not a probability"),
    (model_text("0.6", "NaN"), r"state s0, action a2: nan is not a probability"),
    (model_text("0.6", "true"), r"state s0, action a2: True is not a probability"),
    (model_text("0.6", '"0.6"'), r"state s0, action a2: '0\.6' is not a probability"),
    (model_text('"s1", 10', '"s1", NaN'), r"state s0, action a1: nan is not a finite reward"),
    (model_text('"s1", 10', '"s1", 1e999'), r"state s0, action a1: inf is not a finite reward"),
    (model_text('"s1", 10', '"s1", 1' + 400 * "0"), r"state s0, action a1: 10+ is not a finite reward"),
    (model_text('"s1", 10', '"s7", 10'), r"state s0, action a1: unknown next state 's7'"),
    (model_text('[1.0, "s1", 10]', '[1.0, "s1"]'), r"\[1\.0, 's1'\] is not \[probability, next state, reward\]"),
    (model_text('[[1.0, "s1", 10]]', "7"), r"7 is not \[probability, next state, reward\]"),
    (model_text('[[1.0, "s1", 10]]', "[]"), r"state s0, action a1: the probabilities sum to 0, not to 1"),
    (model_text('{"a1": [[1.0, "sG", 1]]}', "{}"), r"state s1 is not terminal, but has no actions"),
    (model_text('["sG"]', '["sG", "s1"]'), r"state s1 is terminal, but has actions"),
    (model_text('"start": "s0", ', ""), r'"start"'),
    (model_text('"s0"', '"s9"'), r"unknown start state 's9'"),
    (model_text('"s0"', '{"s0": 0.5}'), r"start states must be at least 0 and sum to 1"),
    (model_text('"s0"', '{"s0": null}'), r'"start" must be a state'),
    (model_text('"a2"', '"a1"'), r"the key 'a1' occurs twice"),
    (model_text('"s1": {', '"s0": {'), r"the key 's0' occurs twice"),
    (model_text('"terminal"', '"terminals"'), r"unknown key 'terminals'"),
    (model_text('["sG"]', '"sG"'), r'"terminal" must be a list'),
    (model_text('"a2": [', '\n"a2" ['), r"is not JSON: Expecting ':' delimiter at line 2, column 6"),
    ("", r"is not JSON: Expecting value at line 1, column 1"),
    ("[]", r"a model is"),
    ('{"start": "s0", "transitions": 3}', r"a model is"),
    ('{"start": ["s0"], "transitions": {"s0": {"a": [[1, "s0", 0]]}}}', r"unknown start state"),
    ('{"start": {}, "transitions": {}}', r"the model has no states"),
    ("[" * 100_000, r"is not JSON"),
]


@pytest.mark.parametrize("module", SCRIPTS, ids=lambda module: module.__name__)
@pytest.mark.parametrize("text, message", BAD_MODELS, ids=range(len(BAD_MODELS)))
def test_bad_models_end_in_one_line(module, text, message, monkeypatch, capsys, tmp_path):
    path = tmp_path / "mdp.json"
    path.write_text(text, encoding="utf-8")
    flags = ["--mdp", path, "--output-json", tmp_path / "out.json", "--figure", tmp_path / "figure.png"]
    code, out, err = run(module, monkeypatch, capsys, *flags)
    assert (code, out) == (2, "") and err.count("\n") == 1 and err.startswith("error: ")
    assert re.search(message, err), err
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("module", [script, policy_iteration], ids=lambda module: module.__name__)
def test_probabilities_that_sum_to_1_only_by_rounding(module, monkeypatch, capsys, tmp_path):
    model = {"start": "s", "terminal": ["g"], "transitions": {"s": {"a": [[1, "s", 0], [1e-12, "g", 1]]}}}
    code, _, err = run(module, monkeypatch, capsys, "--mdp", written(tmp_path / "mdp.json", model))
    assert code == 2 and err.count("\n") == 1 and "no single solution" in err


@pytest.mark.parametrize("module", SCRIPTS, ids=lambda module: module.__name__)
@pytest.mark.parametrize("flags, message", [
    (["--discount", "1.1"], r"discount must be in \[0, 1\], not 1\.1"),
    (["--discount", "-0.1"], r"discount must be in \[0, 1\]"),
    (["--discount", "nan"], r"discount must be in \[0, 1\], not nan"),
    (["--discount", "much"], r"discount.*see --help"),
    (["--tolerance", "0"], r"tolerance must be above 0"),
    (["--max-iterations", "0"], r"max-iterations must be at least 1"),
    (["--no-such-flag", "1"], r"no-such-flag"),
    (["--mdp", "nowhere.json"], r"nowhere\.json"),
    (["--mdp", "nowhere.json", "--env-id", "Taxi-v3"], r"give one of them"),
    (["--env-id", "CartPole-v1"], r"CartPole-v1 has no model"),
    (["--env-id", "NoSuchWorld-v0"], r"Gymnasium cannot make NoSuchWorld-v0"),
    (["--env-id", "FrozenLake-v1", "--env-kwargs", "map_name=9x9"], r"cannot make FrozenLake-v1 with"),
    (["--env-id", "FrozenLake-v1", "--env-kwargs", "slippery"], r"'slippery' is not name=value"),
    (["--env-kwargs", "map_name=8x8"], r"--env-kwargs needs --env-id"),
    (["--figure", "picture.txt"], r"must end in \.png"),
    (["--output-json", "no/such/folder/out.json"], r"cannot write"),
])  # fmt: skip
def test_bad_flags_end_in_one_line(module, flags, message, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    code, out, err = run(module, monkeypatch, capsys, *flags)
    assert (code, out) == (2, "") and err.count("\n") == 1 and err.startswith("error: ")
    assert re.search(message, err), err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", [module.__name__ for module in SCRIPTS])
def test_the_command_line_itself(name, command_line, tmp_path):
    finished = command_line(f"{name}.py")
    assert (finished.returncode, finished.stderr) == (0, "") and "V(s0) = " in finished.stdout
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("module", SCRIPTS, ids=lambda module: module.__name__)
def test_the_smallest_models(module, monkeypatch, capsys, tmp_path):
    for model in ({"start": "g", "terminal": ["g"], "transitions": {}},
                  {"start": "s", "transitions": {"s": {"a": [[1, "s", 0]]}}}):  # fmt: skip
        for discount in (0, 0.5, 1):
            flags = ["--mdp", written(tmp_path / "mdp.json", model), "--discount", discount]
            code, out, err = run(module, monkeypatch, capsys, *flags)
            assert (code, err) == (0, "") and ") = 0\n" in out


def test_unreadable_files(monkeypatch, capsys, tmp_path):
    path = tmp_path / "mdp.json"
    path.write_bytes(b"\xff\xfe{}")
    code, _, err = run(script, monkeypatch, capsys, "--mdp", path)
    assert code == 2 and "is not JSON" in err
    path.write_text("\N{ZERO WIDTH NO-BREAK SPACE}" + model_text(), encoding="utf-8")  # as Windows editors begin a file
    assert run(script, monkeypatch, capsys, "--mdp", path)[0] == 0


def test_max_iterations_is_an_error(monkeypatch, capsys):
    policy = ["--policy", "s0=a2 s1=a1 s2=a2", "--max-iterations"]
    code, _, err = run(script, monkeypatch, capsys, *policy, 29)
    assert code == 2 and "V^π has not converged after --max-iterations 29" in err
    assert run(script, monkeypatch, capsys, *policy, 30)[0] == 0
