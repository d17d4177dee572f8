"""dqn_atari.py: a resumed run is the one that never stopped; no crash or bad file does harm."""

import copy
import gc
import json
import os
import pickle
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import dqn_atari as dqn
import numpy as np
import pytest
import test_dqn_atari
import torch
from conftest import ALGORITHMS
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

FRAMES = 460
SHORT = test_dqn_atari.SHORT | dict(
    environment_train_frames_max=FRAMES, environment_evaluation_interval_episodes=2,
    environment_evaluation_episodes=1, environment_checkpoint_interval_episodes=2,
    agent_replay_buffer_initial=150, agent_replay_buffer_maximum_length=350,
    agent_epsilon_greedy_epsilon_evaluation=0.5, agent_epsilon_greedy_annealing=400,
    optimizer_q_network_parameter_update_interval_frames=70, checkpoint_interval_minutes=0.00001)


def run(*flags, each_frame=lambda frame: None, **changed):
    """The script in this process; each_frame(n) follows the n-th transition. The exit code."""
    if "--resume" not in flags:
        flags = *flags, *test_dqn_atari.as_flags(SHORT | changed)
    add = dqn.ReplayMemory.add
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["dqn_atari.py", *map(str, flags)])
        patch.setattr(dqn, "REPORT_INTERVAL", 50)
        patch.setattr(dqn.ReplayMemory, "add",
                      lambda memory, *all: (add(memory, *all), each_frame(memory.added)))
        try:
            dqn.main(dqn.read_args())
            return 0
        except SystemExit as stopped:
            return stopped.code
        finally:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            torch.set_flush_denormal(False)
            torch.set_num_threads(1)
            gc.collect()  # a lock ends with its run


def stop_at(frame: int, number: int):
    return lambda n: signal.raise_signal(number) if n == frame else None


def only(folder: Path) -> Path:
    (run_dir,) = folder.iterdir()
    return run_dir


def child(*arguments, limit: int = -1) -> subprocess.CompletedProcess:
    """run(*arguments) in a process of its own, whose files are at most `limit` bytes long."""
    code = ("import resource, signal, sys, test_dqn_atari_resume as t\n"
            f"resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}))\n"
            "frame, number, *flags = sys.argv[1:]\n"
            "sys.exit(t.run(*flags, each_frame=t.stop_at(int(frame), int(number))))")
    path = os.pathsep.join(map(str, (ALGORITHMS, Path(__file__).parent)))
    return subprocess.run([sys.executable, "-c", code, *map(str, arguments)], timeout=120,
                          env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True)


def plain(value):
    """Tensors as arrays' bytes and floats as text, so that == compares everything, NaN too."""
    if isinstance(value, float):
        return repr(value)
    if torch.is_tensor(value):
        return value.shape, value.dtype, value.contiguous().numpy().tobytes()
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items() if key not in ("seconds", "speeds")}
    return [plain(item) for item in value] if isinstance(value, list | tuple) else value


def everything(run_dir: Path) -> dict:
    """All that a run leaves, but its clocks."""
    saved = torch.load(run_dir / "checkpoint.pt", weights_only=True)
    replay = dqn.ReplayMemory(SHORT["agent_replay_buffer_maximum_length"], (4, 44, 52), "cpu")
    replay.load_state_dict(saved.pop("replay"))
    rows = [row.rsplit(",", 1)[0] for row in (run_dir / "evaluations.csv").read_text().splitlines()]
    args, test = [json.loads((run_dir / f"{x}.json").read_text()) for x in ("args", "test")]
    return plain(saved) | {
        "replay": (replay.added, replay.frames.tolist(), replay.numbers.tobytes()), "rows": rows,
        "test": {name: test[name] for name in ("scores", "lengths", "updates")},
        "args": {name: args[name] for name in args if name != "runs_dir"},
        "q_network.pt": plain(torch.load(run_dir / "q_network.pt", weights_only=True)["q_network"])}


@pytest.fixture(scope="module")
def straight(tmp_path_factory):
    """The run directory of a run that never stopped, and what it left."""
    folder = tmp_path_factory.mktemp("straight")
    assert run(runs_dir=folder) == 0
    left = everything(only(folder))
    assert len(left["rows"]) > 2 and left["test"]["scores"]
    return only(folder), left


@pytest.fixture
def stopped(straight, tmp_path):
    """A copy of that run directory, to do harm to."""
    return Path(shutil.copytree(straight[0], tmp_path / "stopped"))


def refused(run_dir: Path, *flags) -> None:
    """Resuming ends with one line, and touches no file."""
    before = {path.name: path.read_bytes() for path in run_dir.iterdir()}
    code = run("--resume", run_dir, *flags)
    assert isinstance(code, str) and code.startswith("error: ") and "\n" not in code
    assert {path.name: path.read_bytes() for path in run_dir.iterdir()} == before


@pytest.mark.parametrize("frame, number", [(100, signal.SIGTERM), (271, signal.SIGINT),
                                           ("life lost", signal.SIGTERM), (FRAMES, signal.SIGINT)])
def test_stopped_and_resumed_is_never_stopped(straight, tmp_path, frame, number):
    expected = straight[1]
    if frame == "life lost":
        frame = int(expected["rows"][2].split(",")[0])  # where the run evaluates, too
    assert run(runs_dir=tmp_path, each_frame=stop_at(frame, number)) == 128 + number
    saved = torch.load(only(tmp_path) / "checkpoint.pt", weights_only=True)
    assert saved["counters"]["frames"] == frame and not (only(tmp_path) / "test.json").exists()
    assert run("--resume", only(tmp_path)) == 0
    assert everything(only(tmp_path)) == expected


def test_killed_and_resumed_is_never_stopped(straight, tmp_path):
    flags = test_dqn_atari.as_flags(SHORT | {"runs_dir": tmp_path})
    assert child(230, int(signal.SIGKILL), *flags).returncode == -9
    checkpoint = only(tmp_path) / "checkpoint.pt"
    assert torch.load(checkpoint, weights_only=True)["counters"]["frames"] == 200
    assert child(390, int(signal.SIGKILL), "--resume", only(tmp_path)).returncode == -9
    assert torch.load(checkpoint, weights_only=True)["counters"]["frames"] == 350
    assert run("--resume", only(tmp_path)) == 0
    assert everything(only(tmp_path)) == straight[1]


def test_trained_on_is_trained_longer_from_the_start(straight, tmp_path, monkeypatch):
    assert run(runs_dir=tmp_path, environment_train_frames_max=250) == 0
    early = (only(tmp_path) / "checkpoint.pt").read_bytes()
    flags = "--resume", only(tmp_path), "--environment-train-frames-max", FRAMES
    assert run(*flags, each_frame=stop_at(300, signal.SIGTERM)) == 143
    assert not (only(tmp_path) / "test.json").exists()  # it was the shorter run's
    (only(tmp_path) / "checkpoint.pt").write_bytes(early)  # frames 251 to 300 come again
    assert run("--resume", only(tmp_path)) == 0
    assert everything(only(tmp_path)) == straight[1]
    curve = EventAccumulator(str(only(tmp_path))).Reload().Scalars("charts/SPS")
    assert [point.step for point in curve] == list(range(50, FRAMES, 50))  # each once
    monkeypatch.setattr(dqn, "evaluate", lambda *_, number: signal.raise_signal(signal.SIGINT))
    with pytest.raises(KeyboardInterrupt):  # its test, repeated, is cut off
        run("--resume", only(tmp_path))
    assert (only(tmp_path) / "test.json").exists()


def test_the_precision_and_the_threads_of_a_run_are_kept(tmp_path, monkeypatch):
    chosen, seen, update = ["bfloat16"], [], dqn.update
    monkeypatch.setattr(dqn, "choose_precision", lambda args, q_network, shape: (
        q_network.head.bias.data.fill_(7), chosen.pop())[1])  # once; it has a copy to spoil
    monkeypatch.setattr(dqn, "update", lambda *all: (seen.append((
        all[-1], torch.get_num_threads(), all[0].head.bias.max() < 1)), update(*all))[1])
    code = run(runs_dir=tmp_path, precision="auto", threads=0, optimizer_name="RMSprop",
               environment_train_frames_max=200, each_frame=stop_at(170, signal.SIGTERM))
    args = json.loads((only(tmp_path) / "args.json").read_text())
    assert (code, args["precision"], args["threads"], args["device"]) == (143, "bfloat16", 1, "cpu")
    torch.set_num_threads(2)  # another machine
    assert run("--resume", only(tmp_path)) == 0
    assert seen == [("bfloat16", 1, True)] * 13


@pytest.mark.parametrize("game", ["Qbert", "Tetris", "Pong", "Breakout"])
def test_the_emulator_goes_on_where_it_was(game, tmp_path):
    args = dqn.Args(env_id=f"ALE/{game}-v5", environment_no_op_max=0)
    one, other = [dqn.FrameHistory(dqn.make_env(args, np.random.default_rng(0), True), 4)
                  for _ in range(2)]
    one.reset(seed=1)
    rng = np.random.default_rng(1)

    def play(env: dqn.gym.Env, action: int) -> list:
        state, reward, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            state, _ = env.reset()
        ale = env.unwrapped.ale
        names = "lives", "episode_returns", "episode_lengths"
        return [state, reward, terminated, ale.getScreenRGB().tobytes(), ale.getRAM().tobytes(),
                ale.getEpisodeFrameNumber(), *map(env.get_wrapper_attr, names)]
    rewards = [play(one, int(rng.integers(one.action_space.n)))[1] for _ in range(120)]
    assert min(rewards) == -(game == "Pong")  # a lost point is -1
    torch.save(dqn.environment_state(one), tmp_path / "state")
    other.reset(seed=1)
    dqn.restore_environment(other, torch.load(tmp_path / "state", weights_only=True))
    assert other.history == one.history
    for _ in range(500):
        action = int(rng.integers(one.action_space.n))
        assert play(one, action) == play(other, action)


def test_two_processes_cannot_write_one_run(straight, tmp_path):
    seen = []

    def meanwhile(frame):
        if frame == 230:
            before = {path: path.read_bytes() for path in only(tmp_path).iterdir()}
            seen.append(child(0, 0, "--resume", only(tmp_path)))
            assert {path: path.read_bytes() for path in only(tmp_path).iterdir()} == before
    assert run(runs_dir=tmp_path, each_frame=meanwhile) == 0
    assert seen[0].returncode == 1 and seen[0].stderr.count("\n") == 1, seen[0].stderr
    assert everything(only(tmp_path)) == straight[1]


class Hostile(str):
    """A path. Unpickling it makes the file."""
    def __reduce__(self):
        return open, (str(self), "w")


def test_damaged_and_mistaken_checkpoints_are_refused(stopped, tmp_path):
    path, made = stopped / "checkpoint.pt", tmp_path / "made"
    whole, saved = path.read_bytes(), torch.load(path, weights_only=True)
    contents = [b"", b"text", whole[: len(whole) // 2], whole[:-1], pickle.dumps(Hostile(made))]
    for place in np.random.default_rng(0).integers(len(whole), size=8):
        contents.append(whole[:place] + bytes([whole[place] ^ 4]) + whole[place + 1 :])
    for content in contents:
        path.write_bytes(content)
        refused(stopped)
    other = copy.deepcopy(saved)
    other["q_network"]["head.bias"] = torch.zeros(6)  # of another game
    for foreign in ({"weights": 1}, [1], saved | {"counters": {"steps": 1}}, other,
                    saved | {"environment": {}}, saved | {"counters": Hostile(str(made))}):
        torch.save(foreign, path)
        refused(stopped)
    path.unlink()
    refused(stopped)
    assert not made.exists()


def test_contradictions_are_refused(stopped):
    refused(stopped, "--seed", 3)
    refused(stopped, "--agent-discount-factor", 0.5, "--environment-train-frames-max", 900)
    refused(stopped, "--environment-train-frames-max", FRAMES - 1)
    parallel = json.loads((stopped / "args.json").read_text()) | {"num_simulators": 8}
    for text in ("{", "[1]", '{"steps": 1}', json.dumps(parallel)):
        (stopped / "args.json").write_text(text)
        refused(stopped)
    (stopped / "args.json").unlink()
    refused(stopped)


@pytest.mark.parametrize("flags", [
    "--env-id NoSuchGame-v0", "--env-id CartPole-v1", "--env-id ale_py:ALE/Pong-v5", "--seed -1",
    "--agent-update-frequency -4", "--agent-replay-buffer-initial 0", "--threads -1",
    "--agent-epsilon-greedy-epsilon-final 2", "--agent-discount-factor -0.5",
    "--optimizer-learning-rate nan", "--agent-replay-buffer-initial 351",
    "--environment-state-width 35", f"--device {'mps' if torch.cuda.is_available() else 'cuda'}"])
def test_bad_input_is_refused_in_one_line(flags, tmp_path):
    name, value = flags.split()
    code = run(**{name[2:].replace("-", "_"): value, "runs_dir": tmp_path / "runs"})
    assert isinstance(code, str) and code.startswith("error: ") and "\n" not in code
    assert not (tmp_path / "runs").exists()


def test_a_full_disk_ends_the_run_in_one_line_and_it_can_be_resumed(straight, tmp_path):
    assert run(runs_dir=tmp_path, each_frame=stop_at(180, signal.SIGTERM)) == 143
    before = (only(tmp_path) / "checkpoint.pt").read_bytes()
    done = child(0, 0, "--resume", only(tmp_path), limit=1_500_000)
    last = done.stderr.splitlines()[-1]
    assert done.returncode == 1 and "Traceback" not in done.stderr, done.stderr
    assert last.startswith("error: ") and (only(tmp_path) / "checkpoint.pt").read_bytes() == before
    assert not list(only(tmp_path).glob("*.tmp")) and not (only(tmp_path) / "test.json").exists()
    assert run("--resume", only(tmp_path)) == 0
    assert everything(only(tmp_path)) == straight[1]


@pytest.mark.parametrize("frame, last", [(230, 200), (455, 450), (460, 450)])
def test_a_weight_that_is_not_finite_ends_the_run_and_is_in_no_checkpoint(
        tmp_path, monkeypatch, frame, last):
    update, frames = dqn.update, []

    def broken(q_network, *rest):
        loss_and_q = update(q_network, *rest)
        if frames[-1] >= frame:
            torch.nn.init.constant_(q_network.layers[0].bias, torch.nan)
        return loss_and_q
    monkeypatch.setattr(dqn, "update", broken)
    code = run(runs_dir=tmp_path, each_frame=frames.append)
    saved = torch.load(only(tmp_path) / "checkpoint.pt", weights_only=True)
    assert saved["counters"]["frames"] == last
    assert code.startswith("error: ") and not (only(tmp_path) / "test.json").exists()
    assert all(θ.isfinite().all() for θ in saved["q_network"].values())
