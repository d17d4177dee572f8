"""dqn_atari_ablation.py: the arms do what their names say, the studies repeat nothing, the tables mix nothing."""

import csv
import dataclasses
import itertools
import json
import math
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import dqn_atari as dqn
import dqn_atari_ablation as ablation
import numpy as np
import pytest
import scipy.stats
import torch
from conftest import ALGORITHMS
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from test_dqn_atari import BREAKOUT, same, weights
from test_dqn_atari_resume import plain, posix, stop_at, wait_for_the_next_second

SHORT = dict(device="cpu", environment_train_frames_max=400, agent_replay_buffer_initial=100,
             agent_replay_buffer_maximum_length=150, optimizer_minibatch_size=32, agent_update_frequency=8,
             environment_test_frames=300,
             environment_evaluation_interval_episodes=3, environment_evaluation_episodes=1,
             agent_epsilon_greedy_epsilon_evaluation=0.5, optimizer_q_network_parameter_update_interval_frames=104)
HELD_OUT_STATES = ablation.HELD_OUT_STATES
ARMS = list(itertools.product((True, False), (True, False)))  # target network, replay buffer


@pytest.fixture(autouse=True)
def few_held_out_states(monkeypatch):
    monkeypatch.setattr(ablation, "HELD_OUT_STATES", 20)


@pytest.fixture(autouse=True)
def signal_handlers():
    handlers = {signum: signal.getsignal(signum) for signum in (signal.SIGINT, signal.SIGTERM)}
    yield
    for signum, handler in handlers.items():
        signal.signal(signum, handler)


def run(folder: Path, module=ablation, before_frame=None, argv=(), **flags) -> Path:
    """main() of a script in this process; before_frame(n, transition) is called when a transition is stored."""
    with pytest.MonkeyPatch.context() as patch:
        add = module.ReplayMemory.add

        def spy(memory, *transition):
            add(memory, *transition)
            if before_frame:
                before_frame(memory.added, transition)

        patch.setattr(module.ReplayMemory, "add", spy)
        patch.setattr(module, "LOG_INTERVAL", 50)
        patch.setattr(sys, "argv", ["script.py", *argv])
        args = module.parse_args(module.Args) if argv else module.Args(**(
            SHORT | {"env_id": BREAKOUT, "runs_dir": str(folder)} | flags))
        module.main(args)
    return max(folder.glob("*"), key=lambda path: path.stat().st_mtime)


def read_json(path: Path) -> dict:
    return json.loads(path.read_text())


# ---- the arms --------------------------------------------------------------------------------------


def test_with_everything_on_a_run_is_bit_identical_to_dqn_atari(tmp_path):
    left = []
    for module in (dqn, ablation):
        run_dir = run(tmp_path / module.__name__, module, environment_test_frames=700)
        state, frames = module.load_checkpoint(run_dir / "checkpoint.pt")
        test = read_json(run_dir / "test.json")
        rows = [{name: value for name, value in row.items() if name not in ("seconds", "held_out_max_q_mean")}
                for row in state["counters"].pop("evaluation_rows")]
        assert len(rows) > 1 and test["scores"]
        for clock in ("seconds", "peak_memory"):
            del state["counters"][clock]
        del state["args"]
        left.append((plain(state), frames, rows, test["scores"], test["lengths"], plain(weights(run_dir))))
    assert left[0] == left[1]


def test_args_are_those_of_dqn_atari_and_the_ablation():
    own = {field.name: field.default for field in dataclasses.fields(ablation.Args)}
    theirs = {field.name: field.default for field in dataclasses.fields(dqn.Args)}
    assert list(own)[:23] == list(theirs)[:23]  # Table 3
    assert {name: own[name] for name in theirs} == theirs | {"env_id": BREAKOUT}
    assert {name: own[name] for name in own if name not in theirs} == {
        "initialization": "orthogonal", "target_network": True, "replay_buffer": True, "study": "", "seeds": 1,
        "list": False, "table": "", "markdown": False, "figure": ""}


def equal(online: dict, target: dict) -> bool:
    """Whether θ⁻ = θ in the precision of θ⁻."""
    return same(target, {name: tensor.to(target[name].dtype) for name, tensor in online.items()})


@pytest.fixture(scope="module")
def arms(tmp_path_factory):
    """Run the four arms of Table 6: run directory, transitions as they were stored, the weights that learning began
    with, and for each update the frame, the minibatch and whether it found θ⁻ = θ."""
    records = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ablation, "HELD_OUT_STATES", 20)
        original = ablation.update
        for target, replay in ARMS:
            stored, updates, first = [], [], {}

            def spy(q_network, working, target_network, optimizer, minibatch, *rest, of=(stored, updates, first)):
                stored, updates, first = of
                if not first:
                    first |= {name: tensor.clone() for name, tensor in q_network.state_dict().items()}
                updates.append((len(stored), minibatch, equal(q_network.state_dict(), target_network.state_dict())))
                result = original(q_network, working, target_network, optimizer, minibatch, *rest)
                assert all(parameter.grad is None for parameter in target_network.parameters())
                return result

            patch.setattr(ablation, "update", spy)
            run_dir = run(tmp_path_factory.mktemp("arm"), target_network=target, replay_buffer=replay,
                          before_frame=lambda _, transition, stored=stored: stored.append(transition))
            records[target, replay] = run_dir, stored, first, updates
    return records


def test_without_target_network_no_target_copy_ever_differs_from_the_online_network(arms):
    for (target_network, _), (run_dir, _, _, updates) in arms.items():
        saved = torch.load(run_dir / "checkpoint.pt", weights_only=True)
        equal_at_the_end = equal(saved["q_network"], saved["target_network"])
        if target_network:
            # copied at frames 104, 208 and 312: equal at the first update and at the one after each copy
            assert [frame for frame, _, is_equal in updates if is_equal] == [104, 112, 216, 320]
            assert not equal_at_the_end
        else:
            assert all(is_equal for *_, is_equal in updates) and equal_at_the_end


def test_without_replay_buffer_the_minibatch_is_the_last_transitions_in_order(arms):
    _, decode = ablation.frame_encoding("lz4", 84, 84, torch.device("cpu"))
    for (_, replay_buffer), (_, stored, _, updates) in arms.items():
        last = []
        for frame, minibatch, _ in updates:
            s, a, r, s_next, terminal = zip(*stored[frame - 32 : frame], strict=True)
            expected = (torch.stack([decode(state) for state in s]), torch.tensor(a),
                        torch.tensor(r, dtype=torch.float32), torch.stack([decode(state) for state in s_next]),
                        torch.tensor(terminal))
            last.append(all(torch.equal(one, other) for one, other in zip(minibatch, expected, strict=True)))
        assert (not any(last)) if replay_buffer else all(last)


def test_arms_differ_in_their_parts_and_in_nothing_else(arms):
    runs = [weights(run_dir) for run_dir, *_ in arms.values()]
    assert not any(same(one, other) for one, other in itertools.combinations(runs, 2))
    # the same frames are random, the same ones are updated at, and learning starts from the same weights
    assert all([frame for frame, *_ in updates] == list(range(104, 401, 8)) for *_, updates in arms.values())
    first = [(stored[:100], plain(weights)) for _, stored, weights, _ in arms.values()]
    assert all(other == first[0] for other in first)


@pytest.fixture(scope="module")
def initial_weights(tmp_path_factory):
    """Weights of a run that stops before it learns, by --initialization."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ablation, "HELD_OUT_STATES", 1)
        return {name: weights(run(tmp_path_factory.mktemp(name), environment_train_frames_max=10,
                                  environment_test_frames=1, initialization=name))
                for name in ("default", "he", "orthogonal")}


@pytest.mark.parametrize(("layer", "fan_in"), [("conv1", 4 * 8 * 8), ("conv2", 32 * 4 * 4), ("conv3", 64 * 3 * 3)])
def test_initializations_by_their_statistics(initial_weights, layer, fan_in):
    default, he, orthogonal = (initial_weights[name][f"layers.{layer}.weight"].flatten(1).double()
                               for name in ("default", "he", "orthogonal"))
    assert torch.allclose(orthogonal @ orthogonal.T, torch.eye(len(orthogonal)).double(), atol=1e-5)
    n, bound = he.numel(), 1 / math.sqrt(fan_in)  # PyTorch: uniform between ± 1/√fan-in; He: normal, variance 2/fan-in
    for filters, variance, kurtosis in ((default, bound**2 / 3, 1.8), (he, 2 / fan_in, 3.0)):
        assert filters.shape == (orthogonal.shape[0], fan_in)
        assert abs(filters.mean()) < 5 * math.sqrt(variance / n)
        assert filters.square().mean().item() == pytest.approx(variance, rel=5 * math.sqrt((kurtosis - 1) / n))
        assert (filters**4).mean().item() / variance**2 == pytest.approx(kurtosis, rel=0.2)
    assert 0.99 * bound < default.abs().max() <= bound


def test_initialization_touches_the_convolutions_weights_only(initial_weights):
    for one, other in itertools.combinations(initial_weights.values(), 2):
        for name, tensor in one.items():
            assert torch.equal(tensor, other[name]) == ("conv" not in name or name.endswith("bias")), name


# ---- the held-out states ---------------------------------------------------------------------------


def test_held_out_states_are_random_play_of_the_seed(monkeypatch):
    monkeypatch.setattr(ablation, "HELD_OUT_STATES", 60)
    encoding = ablation.frame_encoding("lz4", 84, 84, torch.device("cpu"))
    states, again, other = (ablation.held_out_states(ablation.Args(seed=seed), encoding) for seed in (1, 1, 2))
    assert (states.shape, states.dtype) == ((60, 4, 84, 84), torch.uint8)
    assert torch.equal(states, again) and not torch.equal(states, other)
    assert len({state.numpy().tobytes() for state in states}) > 50
    assert HELD_OUT_STATES == 500


def test_mean_max_q_is_in_every_row_every_log_and_the_test(arms, capsys):
    for run_dir, *_ in arms.values():
        rows = list(csv.DictReader((run_dir / "evaluations.csv").open()))
        assert len(rows) > 1 and list(rows[0])[-2:] == ["seconds", "held_out_max_q_mean"]
        logged = EventAccumulator(str(run_dir)).Reload().Scalars("evaluation/held_out_max_q_mean")
        assert [event.value for event in logged] == pytest.approx([float(r["held_out_max_q_mean"]) for r in rows])
        assert [event.step for event in logged] == [int(row["frames"]) for row in rows]
        test = read_json(run_dir / "test.json")
        network = ablation.QNetwork(4, 84, 84, 4)
        network.load_state_dict(weights(run_dir))
        args = ablation.Args(**test["args"])
        states = ablation.held_out_states(args, ablation.frame_encoding("lz4", 84, 84, torch.device("cpu")))
        naive = [max(network(state[None])[0].tolist()) for state in states]
        assert test["held_out_max_q_mean"] == pytest.approx(sum(naive) / 20, rel=1e-4)


# ---- stopping, resuming, studies -------------------------------------------------------------------


@posix
def test_an_arm_that_was_cut_off_goes_on_as_if_it_never_stopped(arms, tmp_path):
    try:
        run(tmp_path, before_frame=stop_at(250), target_network=False, replay_buffer=False)
    except SystemExit as stop:  # pytest.raises would keep main's frame alive, and with it the lock
        assert stop.code == 143
    (run_dir,) = tmp_path.iterdir()
    assert run(tmp_path, argv=["--resume", str(run_dir)]) == run_dir
    straight = arms[False, False][0]
    assert same(weights(run_dir), weights(straight))
    columns = [[line.split(",")[-1] for line in (folder / "evaluations.csv").read_text().splitlines()]
               for folder in (run_dir, straight)]
    assert columns[0] == columns[1] and len(columns[0]) > 2


TINY = ["--environment-train-frames-max", "30", "--environment-test-frames", "1"]


@pytest.fixture
def study(tmp_path, monkeypatch, capsys):
    """Run a study's main() in tmp_path, its commands in this process too; returns (exit code, printed lines,
    commands)."""
    monkeypatch.chdir(tmp_path)

    def call(*flags: str, before_frame=None):
        commands = []

        class InThisProcess:
            def __init__(self, command):
                commands.append(command)
                self.code = 0
                try:
                    run(tmp_path / "runs", argv=command[2:], before_frame=before_frame)
                except SystemExit as stopped:
                    self.code = stopped.code

            def poll(self):
                return self.code

            wait = poll

        with monkeypatch.context() as patch:
            patch.setattr(ablation.subprocess, "Popen", InThisProcess)
            patch.setattr(sys, "argv", ["script.py", *flags])
            code = 0
            try:
                ablation.main(ablation.parse_args(ablation.Args))
            except SystemExit as stopped:
                code = stopped.code
        return code, capsys.readouterr().out.splitlines(), commands

    return call


EXPECTED_ARMS = {
    "initialization": [["--initialization", "default"], ["--initialization", "he"], []],
    "ablation": [[], ["--no-target-network"], ["--no-replay-buffer"], ["--no-target-network", "--no-replay-buffer"]],
    "games": [[], *(["--env-id", f"{game}NoFrameskip-v4"] for game in ("Enduro", "Pong", "Riverraid",
                                                                      "SpaceInvaders"))],
}


@pytest.mark.parametrize("name", EXPECTED_ARMS)
def test_list_prints_one_complete_command_per_arm_and_seed(study, tmp_path, name):
    code, lines, commands = study("--study", name, "--seeds", "3", "--seed", "2", "--optimizer-learning-rate", "0.001",
                                  "--list")
    assert (code, commands, list(tmp_path.iterdir())) == (0, [], [])
    listed, places = [], set()
    for line in lines:
        python, script, *flags = shlex.split(line)
        assert Path(python).samefile(sys.executable) and Path(script).samefile(ALGORITHMS / "dqn_atari_ablation.py")
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "argv", [script, *flags])
            args = ablation.parse_args(ablation.Args)
        assert (args.study, args.resume, args.optimizer_learning_rate) == ("", "auto", 0.001)
        listed.append((args.seed, args.env_id, args.initialization, args.target_network, args.replay_buffer))
        places.add((args.runs_dir, args.seed, args.env_id))
    expected = []
    for seed, flags in itertools.product((2, 3, 4), EXPECTED_ARMS[name]):
        given = dict(itertools.pairwise(flags))
        expected.append((seed, given.get("--env-id", BREAKOUT), given.get("--initialization", "orthogonal"),
                         "--no-target-network" not in flags, "--no-replay-buffer" not in flags))
    assert listed == expected and len(places) == len(listed)  # side by side, no two can want the same run directory


@posix
def test_a_study_skips_what_is_finished_and_resumes_what_was_cut_off(study, tmp_path):
    interrupted = []

    def stop_the_second(frame, _):
        if frame == 15 and len(list((tmp_path / "runs").glob("*/*"))) == 2 and not interrupted:
            interrupted.append(frame)
            signal.raise_signal(signal.SIGTERM)

    code, lines, commands = study("--study", "ablation", *TINY, before_frame=stop_the_second)
    assert (code, len(commands)) == (1, 4)  # the second ended before its time, the others went on
    runs = sorted((tmp_path / "runs").glob("*/*"))
    assert len(runs) == 4 and [not (run_dir / "test.json").exists() for run_dir in runs].count(True) == 1

    code, lines, commands = study("--study", "ablation", *TINY)
    assert (code, len(commands)) == (0, 1) and "--no-target-network" in commands[0]
    assert sum(": finished, runs" in line for line in lines) == 3
    assert any("resumed at frame 15" in line for line in lines)
    assert sorted((tmp_path / "runs").glob("*/*")) == runs
    assert all(read_json(run_dir / "test.json")["frames"] == 30 for run_dir in runs)

    # Tables 4 and 6 share the arm with everything on; more frames train the same runs on; other flags are other runs
    code, lines, commands = study("--study", "initialization", *TINY)
    assert (code, len(commands)) == (0, 2) and len(list((tmp_path / "runs").glob("*/*"))) == 6
    code, lines, commands = study("--study", "ablation", "--environment-train-frames-max", "40", *TINY[2:])
    assert (code, len(commands)) == (0, 4) and len(list((tmp_path / "runs").glob("*/*"))) == 6
    code, lines, commands = study("--study", "initialization", "--optimizer-learning-rate", "0.001", *TINY)
    assert (code, len(commands)) == (0, 3) and len(list((tmp_path / "runs").glob("*/*"))) == 9


def test_auto_trains_the_longest_run_on_to_the_frames_that_are_asked_for(tmp_path):
    """Also where that number is the default, which a study leaves out of its commands: sys.argv is empty here."""
    longest = run(tmp_path, environment_train_frames_max=150)
    wait_for_the_next_second(longest)
    newest = run(tmp_path, environment_train_frames_max=120)
    assert newest != longest
    run(tmp_path, environment_train_frames_max=200, resume="auto")
    frames = [read_json(run_dir / "test.json")["frames"] for run_dir in (longest, newest)]
    assert frames == [200, 120] and len(list(tmp_path.iterdir())) == 2


@posix
@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_to_the_study_stops_its_run_with_a_checkpoint(signum, tmp_path):
    few = ["--environment-train-frames-max", "100000", "--environment-test-frames", "1"]  # should it be left behind
    command = [sys.executable, ALGORITHMS / "dqn_atari_ablation.py", "--study", "initialization", *few]
    process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        for line in process.stdout:
            if line.startswith("run      "):
                break
        process.send_signal(signum)  # to the study alone
        out, err = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 128 + signum and "Traceback" not in err, err
    assert "stopped at frame" in out and out.endswith("stopped; the same command goes on\n")
    (checkpoint,) = tmp_path.glob("runs/default/*/checkpoint.pt")
    assert len(list(tmp_path.glob("runs/*/*"))) == 1
    ablation.load_checkpoint(checkpoint)


def test_figures_have_five_digits_and_no_power_of_ten():
    shown = {576.9234: "576.92", -0.012345678: "-0.012346", 1.23456e11: "123,460,000,000", 0.0: "0"}
    assert {value: ablation.five_digits(value) for value in shown} == shown


# ---- the tables and the figure ---------------------------------------------------------------------


def write_run(folder: Path, seed: int = 1, score: float | None = 30.0, frames: int = 10_000_000, rows: int = 2,
              script: str = "dqn_atari_ablation", hour: int = 0, **flags) -> Path:
    """A run directory as the script leaves it; the other three figures are 10, 100 and 1000 times the score."""
    module = {"dqn_atari": dqn, "dqn_atari_ablation": ablation}[script]
    args = vars(module.Args(seed=seed, environment_train_frames_max=frames, **flags))
    names = ("score_mean", "score_variance", "length_mean", "length_variance")
    test = {"frames": frames, "seed": seed, "env_id": args["env_id"]}
    test |= {name: None if score is None else score * 10**i for i, name in enumerate(names)}
    run_dir = folder / f"game__{script}__{seed}__20260101-{hour:02}{len(list(folder.glob('*'))):02}00"
    run_dir.mkdir(parents=True)
    (run_dir / "args.json").write_text(json.dumps(args))
    (run_dir / "test.json").write_text(json.dumps(test | ({"args": args} if module is ablation else {})))
    header = ["frames", *names, "seconds"] + (["held_out_max_q_mean"] if module is ablation else [])
    with (run_dir / "evaluations.csv").open("w", newline="") as file:
        table = csv.DictWriter(file, header)
        table.writeheader()
        table.writerows({name: 1000 * (i + 1) if name == "frames" else (score or 0) + i for name in header}
                        for i in range(rows))
    return run_dir


@pytest.fixture
def table(tmp_path, monkeypatch, capsys):
    """Call --table on tmp_path/runs; returns what it printed."""

    def call(*flags: str) -> str:
        monkeypatch.setattr(sys, "argv", ["script.py", "--table", str(tmp_path / "runs"), *flags])
        ablation.main(ablation.parse_args(ablation.Args))
        return capsys.readouterr().out

    return call


def sections(text: str) -> dict[str, dict[str, list[list[str]]]]:
    """A text report: heading -> title -> rows of cells."""
    found, heading = {}, ""
    for block in text.strip().split("\n\n"):
        lines = block.split("\n")
        if len(lines) > 2 and set(lines[2]) == {"-", " "}:
            found[heading][lines[0]] = [re.split(r"  +", line.strip()) for line in lines[3:]]
        elif block.startswith("Not counted"):
            found["Not counted"] = lines[1:]
        elif not block.startswith("Human"):
            heading = block
            found[heading] = {}
    return found


def test_tables_4_5_and_6_beside_the_lectures(table, tmp_path):
    runs = tmp_path / "runs"
    write_run(runs / "deep" / "er", score=31.0)
    write_run(runs, score=33.0, seed=2, env_id="ALE/Breakout-v5", script="dqn_atari")  # the same experiment
    write_run(runs, score=11.5, initialization="he")
    write_run(runs, score=7.25, replay_buffer=False)
    write_run(runs, score=3000.123, env_id="RiverraidNoFrameskip-v4")
    ((heading, tables),) = sections(table()).items()
    assert heading == "10,000,000 frames, Table 3's hyperparameters: ours (the lecture's)"
    baseline = ["2", "32 (32.154)", "320 (3,695.1)", "3,200 (576.92)", "32,000 (29,401)", "-"]
    assert tables == {
        "Table 4: Initialization Strategy Study on Breakout": [
            ["PyTorch Default", "0", "- (11.174)", "- (696.84)", "- (480.43)", "- (22,894)", "-"],
            ["He", "1", "11.5 (22.865)", "115 (749.63)", "1,150 (703.13)", "11,500 (87,811)", "-"],
            ["Orthogonal", *baseline]],
        "Table 5: Game Performance Comparison": [
            ["Breakout", *baseline],
            ["Enduro", "0", "- (258.63)", "- (14,905)", "- (4,500)", "- (2,782,600)", "-"],
            ["Pong", "0", "- (19.083)", "- (5.4014)", "- (1,875)", "- (56,022)", "-"],
            ["River Raid", "1", "3,000.1 (3,459.4)", "30,001 (877,420)", "300,010 (833.33)", "3,000,100 (37,002)", "-"],
            ["Space Invaders", "0", "- (748.14)", "- (30,417)", "- (882.35)", "- (41,330)", "-"]],
        "Table 6: Ablative Study on Breakout": [
            ["Yes", "Yes", *baseline],
            ["No", "Yes", "0", "- (10.549)", "- (1.4201)", "- (639.81)", "- (27,774)", "-"],
            ["Yes", "No", "1", "7.25 (7.4837)", "72.5 (3.9444)", "725 (438.31)", "7,250 (35,112)", "-"],
            ["No", "No", "0", "- (10.701)", "- (1.2104)", "- (671.64)", "- (38,953)", "-"]]}


def test_markdown_holds_the_same_cells(table, tmp_path):
    write_run(tmp_path / "runs", score=31.0)
    write_run(tmp_path / "runs", score=5.0, frames=1000)
    rows = [row for tables in sections(table()).values() for cells in tables.values() for row in cells]
    markdown = table("--markdown")
    lines = [line for line in markdown.splitlines() if line.startswith("|")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert [row for row in cells if row[-1] not in ("---", "IQM of Score [95%]")] == rows
    assert markdown.startswith("## 10,000,000 frames") and "\n## Apart: 1,000 frames" in markdown
    assert "| Target Network | Replay Buffer | Seeds | Episode Score Mean |" in markdown


def test_other_experiments_stand_apart_with_their_label(table, tmp_path):
    runs = tmp_path / "runs"
    write_run(runs, score=31.0)
    others = {"5,000 frames": dict(frames=5000), "50,000,000 frames": dict(frames=50_000_000),
              "10,000,000 frames, --agent-update-frequency 4": dict(agent_update_frequency=4),
              "10,000,000 frames, --environment-test-frames 100": dict(environment_test_frames=100),
              "10,000,000 frames, --optimizer-name RMSprop": dict(optimizer_name="RMSprop")}
    for i, flags in enumerate(others.values()):
        write_run(runs, score=float(i), **flags)
    write_run(runs, score=33.0, seed=2, device="cpu", replay_encoding="raw", environment_evaluation_episodes=3,
              runs_dir="elsewhere")  # none of these can change a score
    found = sections(table())
    assert len(found) == 6 and next(iter(found)).startswith("10,000,000 frames, Table 3's hyperparameters")
    for i, label in enumerate(others):
        ((title, rows),) = found[f"Apart: {label}: ours (the lecture's, of 10,000,000 frames and Table 3's "
                                 "hyperparameters)"].items()
        assert (title, len(rows), rows[0][:3]) == ("Table 5: Game Performance Comparison", 1,
                                                   ["Breakout", "1", f"{i} (32.154)"])
    full = next(iter(found.values()))
    assert all(rows[-1 if "4" in title else 0][-6:-4] == ["2", "32 (32.154)"] for title, rows in full.items())


def test_a_run_that_was_raised_and_not_finished_counts_for_the_frames_of_its_test(table, tmp_path):
    run_dir = write_run(tmp_path / "runs", score=5.0, frames=1000, script="dqn_atari")
    args = read_json(run_dir / "args.json") | {"environment_train_frames_max": 10_000_000}
    (run_dir / "args.json").write_text(json.dumps(args))
    assert list(sections(table())) == [
        "Apart: 1,000 frames: ours (the lecture's, of 10,000,000 frames and Table 3's hyperparameters)"]


def test_what_is_not_counted_is_named(table, tmp_path):
    runs = tmp_path / "runs"
    older = write_run(runs, score=1.0, hour=1)
    write_run(runs / "again", score=31.0, hour=2)  # the same arm and seed: one run, not two seeds
    untested = write_run(runs, hour=3, target_network=False)
    (untested / "test.json").unlink()
    endless = write_run(runs, score=None, hour=4, seed=3)
    mixed = write_run(runs, initialization="he", target_network=False, hour=5)
    found = sections(table())
    left_out = "\n".join(found["Not counted"])
    for path, reason in ((older, "newer"), (untested, "no test yet"), (endless, "no game"), (mixed, "no table")):
        assert re.search(rf"^- {re.escape(str(path))}: .*{reason}", left_out, re.MULTILINE), left_out
    assert len(found["Not counted"]) == 4
    assert next(iter(found.values()))["Table 6: Ablative Study on Breakout"][0][2:4] == ["1", "31 (32.154)"]


def test_an_ablation_on_another_game_is_no_row_of_the_lectures_table(table, tmp_path):
    for target, replay in ARMS:
        write_run(tmp_path / "runs", score=4.0, env_id="PongNoFrameskip-v4", target_network=target,
                  replay_buffer=replay, frames=1000)
    ((title, rows),) = next(iter(sections(table()).values())).items()
    assert title == "Table 6: Ablative Study on Pong"
    assert [row[3] for row in rows] == ["4 (19.083)", "4", "4", "4"]


def test_three_seeds_bring_the_interquartile_mean_and_its_interval(table, tmp_path):
    rng, runs = np.random.default_rng(5), tmp_path / "runs"
    scores = {game: rng.normal(center, spread, 8) for game, (center, spread) in {
        "Breakout": (30, 5), "Enduro": (250, 40), "Pong": (18, 1), "Riverraid": (3000, 500),
        "SpaceInvaders": (700, 60)}.items()}
    for game, values in scores.items():
        for seed, score in enumerate(values):
            write_run(runs, seed=seed, score=float(score), env_id=f"{game}NoFrameskip-v4")
    write_run(runs, seed=1, score=1.0, replay_buffer=False)
    write_run(runs, seed=2, score=2.0, replay_buffer=False)
    text = table()
    tables = next(iter(sections(text).values()))

    def naive(strata: list[np.ndarray]) -> list[float]:
        """Point, low, high by SciPy's trimmed mean and a loop over resamples of each stratum."""
        draws = [scipy.stats.trim_mean(np.concatenate([rng.choice(s, len(s)) for s in strata]), 0.25)
                 for _ in range(1500)]
        return [scipy.stats.trim_mean(np.concatenate(strata), 0.25), *np.percentile(draws, [2.5, 97.5])]

    def numbers(text: str) -> list[float]:
        return [float(number.replace(",", "")) for number in re.findall(r"-?\d[\d,]*\.?\d*", text)]

    for row, values in zip(tables["Table 5: Game Performance Comparison"], scores.values(), strict=True):
        expected = naive([values])
        assert numbers(row[-1])[0] == pytest.approx(expected[0], rel=1e-4)
        assert numbers(row[-1])[1:] == pytest.approx(expected[1:], abs=0.1 * values.std())
    assert tables["Table 6: Ablative Study on Breakout"][2][-1] == "-"  # two seeds

    scale = {"Breakout": (1.7, 30.5), "Enduro": (0, 860.5), "Pong": (-20.7, 14.6), "Riverraid": (1338.5, 17118),
             "SpaceInvaders": (148, 1668.7)}  # random play, a person
    strata = [(values - scale[game][0]) / (scale[game][1] - scale[game][0]) for game, values in scores.items()]
    (line,) = [line for line in text.splitlines() if line.startswith("Human-normalised")]
    ours = numbers(line.split(": ")[1])
    assert ours[:3] == pytest.approx(naive(strata), abs=0.01)
    lecture = (32.154, 258.63, 19.083, 3459.4, 748.14)
    assert ours[3] == pytest.approx(np.mean(sorted((score - low) / (high - low) for score, (low, high) in zip(
        lecture, scale.values(), strict=True))[1:4]), rel=1e-4)


def test_the_figure_holds_every_curve_and_the_lectures_lines(table, tmp_path, monkeypatch):
    runs, figures = tmp_path / "runs", []
    for target, replay in ARMS:
        for seed in (1, 2):
            write_run(runs, score=10.0 * seed + target, target_network=target, replay_buffer=replay, seed=seed)
    write_run(runs, score=2.0, frames=1000, env_id="PongNoFrameskip-v4", script="dqn_atari")
    save = ablation.Figure.savefig
    monkeypatch.setattr(ablation.Figure, "savefig", lambda figure, *a, **b: (figures.append(figure),
                                                                            save(figure, *a, **b)))
    table("--figure", str(tmp_path / "curves.png"))
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")
    panels = figures[0].axes
    curves = [[line for line in panel.lines if line.get_linestyle() == "-"] for panel in panels]
    lecture = [[line.get_ydata()[0] for line in panel.lines if line.get_linestyle() == "--"] for panel in panels]
    assert [len(lines) for lines in curves] == [8, 8, 1, 0]  # dqn_atari.py measures no mean max Q
    assert lecture == [[32.154, 10.549, 7.4837, 10.701], [], [19.083], []]
    assert [list(line.get_xdata()) for line in curves[0]] == [[1000, 2000]] * 8
    assert sorted(line.get_ydata()[0] for line in curves[0]) == [10, 10, 11, 11, 20, 20, 21, 21]
    assert "1,000 frames" in panels[2].get_title() and "Pong" in panels[2].get_title()
    colours = {line.get_color() for line in curves[0]}
    assert len(colours) == 4


# ---- bad input -------------------------------------------------------------------------------------

BROKEN = {
    "test.json": ["", "{", "[]", '{"frames": 10}', '{"frames": "many", "args": {}}', '{"args": 3}',
                  '{"frames": 1, "args": {"no_such_flag": 1}}'],
    "args.json": ["{", "3", '{"no_such_flag": 1}'],
    "evaluations.csv": ["frames,score_mean\n10,many\n", "frames\n10\n", "frames,score_mean\n10\n"],
}


def refused(flags: list[str], folder: Path, monkeypatch, capsys) -> str:
    """The one line of a refusal, which writes nothing."""
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "argv", ["script.py", *flags])
    with pytest.raises(SystemExit) as stopped:
        ablation.main(ablation.parse_args(ablation.Args))
    streams = capsys.readouterr()
    assert stopped.value.code == 2
    assert re.fullmatch(r"error: [^\n]+\n", streams.err) and streams.out == "", streams
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
    return streams.err


@pytest.mark.parametrize(("name", "content"), [(name, text) for name, texts in BROKEN.items() for text in texts])
def test_a_broken_file_is_named_in_one_line(name, content, tmp_path, monkeypatch, capsys):
    write_run(tmp_path / "runs", seed=2)
    run_dir = write_run(tmp_path / "runs", script="dqn_atari" if name == "args.json" else "dqn_atari_ablation")
    (run_dir / name).write_text(content)
    assert str(Path("runs") / run_dir.name / name) in refused(["--table", "runs"], tmp_path, monkeypatch, capsys)


BAD_FLAGS = {
    "--table empty": "no test.json",
    "--table nowhere": "no such folder",
    "--table no_curves --figure curves.png": "no evaluations.csv",
    "--table good --figure curves.txt": ".png, .pdf or .svg",
    "--table good --figure nowhere/curves.png": "cannot be written",
    "--table good --study ablation": "two commands",
    "--figure curves.png": "--figure needs --table",
    "--markdown": "--markdown needs --table",
    "--list": "--list needs --study",
    "--seeds 3": "--seeds needs --study",
    "--study ablation --seeds 0": "--seeds must be above 0",
    "--study ablation --no-replay-buffer": "sets --replay-buffer itself",
    "--study initialization --initialization he": "sets --initialization itself",
    "--study games --env-id PongNoFrameskip-v4": "sets --env-id itself",
    "--study ablation --resume auto": "leave out --resume",
    "--study everything": "'ablation'",
    "--study ablation --agent-discount-factor 2": "between 0 and 1",
    "--initialization xavier": "'he'",
    "--no-target-network --optimizer-minibatch-size 0": "above 0",
    "--resume nowhere": "no run directory",
}


@pytest.mark.parametrize("flags", BAD_FLAGS)
def test_bad_flags(flags, tmp_path, monkeypatch, capsys):
    (tmp_path / "empty").mkdir()
    write_run(tmp_path / "good")
    (write_run(tmp_path / "no_curves") / "evaluations.csv").unlink()
    assert BAD_FLAGS[flags] in refused(flags.split(), tmp_path, monkeypatch, capsys)
