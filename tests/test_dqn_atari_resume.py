"""dqn_atari.py survives: stopping and resuming is never having stopped; crashes, full disks, bad files lose nothing."""

import dataclasses
import json
import os
import pickle
import re
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
import traceback
import zipfile
from pathlib import Path

import dqn_atari as dqn
import numpy as np
import pytest
import torch
from conftest import ALGORITHMS
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

FRAMES = 500
SHORT = dict(device="cpu", precision="bfloat16", environment_train_frames_max=FRAMES, agent_replay_buffer_initial=150,
             optimizer_minibatch_size=8, agent_update_frequency=4, environment_test_frames=150,
             environment_evaluation_interval_episodes=4, environment_evaluation_episodes=1,
             environment_checkpoint_interval_episodes=2, optimizer_q_network_parameter_update_interval_frames=70)
CAP = {"BreakoutNoFrameskip-v4": 108_000, "PongNoFrameskip-v4": 400}  # Pong: an episode every 100 frames
posix = pytest.mark.skipif(os.name != "posix", reason="needs fork, SIGKILL and file-size limits")


def wait_for_the_next_second(run_dir: Path) -> None:
    """TensorBoard reads event files in order of name: the second they were made in, then the process. Only a test
    resumes within that second."""
    made = max((int(path.name.split(".")[3]) for path in run_dir.glob("events*")), default=0)
    while int(time.time()) <= made:
        time.sleep(0.02)


def run(folder: Path, env_id: str = "BreakoutNoFrameskip-v4", resume: Path | None = None, before_frame=None, **flags):
    """main() in this process, new or resumed; before_frame(n, transition) is called when the n-th transition is stored.
    Returns (exit code, run directory)."""
    if resume:
        wait_for_the_next_second(resume)
    with pytest.MonkeyPatch.context() as patch:
        make, add = dqn.make_emulator, dqn.ReplayMemory.add

        def short_games(env_id):
            env = make(env_id)
            env.unwrapped.ale.setInt("max_num_frames_per_episode", CAP[env_id])
            env.unwrapped.load_game()
            return env

        def spy(memory, *transition):
            add(memory, *transition)
            if before_frame:
                before_frame(memory.added, transition)

        patch.setattr(dqn, "make_emulator", short_games)
        patch.setattr(dqn.ReplayMemory, "add", spy)
        patch.setattr(dqn, "LOG_INTERVAL", 20)
        arguments = ["--resume", str(resume)] if resume else []
        arguments += [item for name, value in flags.items() for item in (dqn.flag(name), str(value))] if resume else []
        patch.setattr(sys, "argv", ["dqn_atari.py", *arguments])
        args = dqn.parse_args(dqn.Args)
        if not resume:
            args = dataclasses.replace(args, env_id=env_id, runs_dir=str(folder), **(SHORT | flags))
        code = 0
        try:
            dqn.main(args)
        except SystemExit as stopped:
            code = stopped.code
        finally:
            for signum in (signal.SIGINT, signal.SIGTERM):
                signal.signal(signum, signal.SIG_DFL if signum == signal.SIGTERM else signal.default_int_handler)
    return code, resume or next(folder.iterdir())


def plain(value):
    """Tensors as bytes, so that == compares whole checkpoints."""
    if torch.is_tensor(value):
        return (tuple(value.shape), str(value.dtype), value.contiguous().view(-1).view(torch.uint8).numpy().tobytes())
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    return [plain(item) for item in value] if isinstance(value, list | tuple) else value


def everything(run_dir: Path) -> dict:
    """All that a run leaves, less its clocks: checkpoint, frames, evaluations, scalars, test."""
    state, frames = dqn.load_checkpoint(run_dir / "checkpoint.pt")
    for clock in ("seconds", "peak_memory"):
        del state["counters"][clock]
    for row in state["counters"]["evaluation_rows"]:
        del row["seconds"]
    del state["args"]["runs_dir"]
    events = EventAccumulator(str(run_dir), size_guidance={"scalars": 0}).Reload()
    scalars = {tag: [(event.step, event.value) for event in events.Scalars(tag)]
               for tag in events.Tags()["scalars"] if tag != "charts/frames_per_second"}
    rows = [line.rsplit(",", 1)[0] for line in (run_dir / "evaluations.csv").read_text().splitlines()]
    test = json.loads((run_dir / "test.json").read_text())
    return {"state": plain(state), "frames": frames, "scalars": scalars, "rows": rows, "scores": test["scores"],
            "lengths": test["lengths"]}


@pytest.fixture(scope="module", params=CAP)
def straight(request, tmp_path_factory):
    """A run that never stopped: (game, all that it left, the frames at which something happened)."""
    moments = {"before learning": 140}

    def watch(frame, transition):
        if transition[4] and "a lost life" not in moments:
            moments["a lost life"] = frame
        if frame == 300:
            moments["while learning"] = frame

    code, run_dir = run(tmp_path_factory.mktemp("straight"), request.param, before_frame=watch)
    assert code == 0
    left = everything(run_dir)
    assert len(left["rows"]) > 1
    moments["the end of a game"] = int(left["scalars"]["charts/episodic_length"][0][0])
    moments["the last frame"] = FRAMES
    return request.param, left, moments


def stop_at(frame: int, signum: int = signal.SIGTERM):
    return lambda n, _: signal.raise_signal(signum) if n == frame else None


# ---- exact -----------------------------------------------------------------------------------------


def test_stopping_anywhere_and_resuming_is_never_having_stopped(straight, tmp_path):
    env_id, expected, moments = straight
    for name, frame in moments.items():
        folder = tmp_path / name
        code, run_dir = run(folder, env_id, before_frame=stop_at(frame))
        assert code == 143, name
        saved = dqn.load_checkpoint(run_dir / "checkpoint.pt")[0]
        assert saved["counters"]["frames"] == frame, name
        assert run(folder, env_id, resume=run_dir)[0] == 0, name
        assert everything(run_dir) == expected, name


def test_an_evaluation_that_was_cut_off_is_done_again(straight, tmp_path, monkeypatch):
    env_id, expected, _ = straight
    evaluate, cut = dqn.evaluate, []

    def interrupted(args, q_network, encoding, number, stop, **limit):
        if number == 1 and not cut:
            cut.append(number)
            signal.raise_signal(signal.SIGINT)
        return evaluate(args, q_network, encoding, number, stop, **limit)

    monkeypatch.setattr(dqn, "evaluate", interrupted)
    code, run_dir = run(tmp_path, env_id)
    assert code == 130 and cut and not (run_dir / "evaluations.csv").exists()
    assert run(tmp_path, env_id, resume=run_dir)[0] == 0
    assert everything(run_dir) == expected


def test_a_run_cut_off_between_checkpoints_repeats_what_was_lost(straight, tmp_path):
    env_id, expected, _ = straight

    class PowerCut(BaseException):
        pass

    def cut(frame, _):
        if frame == 430:
            raise PowerCut

    with pytest.raises(PowerCut):
        run(tmp_path, env_id, before_frame=cut)
    (run_dir,) = tmp_path.iterdir()
    assert 0 < dqn.load_checkpoint(run_dir / "checkpoint.pt")[0]["counters"]["frames"] < 430
    assert run(tmp_path, env_id, resume=run_dir)[0] == 0
    assert everything(run_dir) == expected


def test_training_on_is_having_trained_longer_from_the_start(straight, tmp_path):
    env_id, expected, _ = straight
    code, run_dir = run(tmp_path, env_id, environment_train_frames_max=250)
    assert code == 0
    assert run(tmp_path, env_id, resume=run_dir, environment_train_frames_max=FRAMES)[0] == 0
    left = everything(run_dir)
    assert left == expected


@posix
def test_a_kill_anywhere_and_resuming_is_never_having_stopped(straight, tmp_path):
    env_id, expected, moments = straight
    resumed = 0
    for name, frame in moments.items():
        folder = tmp_path / name
        _, status = os.waitpid(in_a_child(folder, env_id=env_id, before_frame=stop_at(frame, signal.SIGKILL)), 0)
        assert os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL, (tmp_path / "child.log").read_text()
        (run_dir,) = folder.iterdir()
        if (run_dir / "checkpoint.pt").exists():
            assert dqn.load_checkpoint(run_dir / "checkpoint.pt")[0]["counters"]["frames"] < frame, name
            assert run(folder, env_id, resume=run_dir)[0] == 0, name
            assert everything(run_dir) == expected, name
            resumed += 1
    assert resumed >= 2


@pytest.mark.parametrize("frame", [258, 259])
def test_a_point_of_the_curves_right_after_resuming_is_not_lost(frame, tmp_path):
    flags = dict(agent_update_frequency=3)  # does not divide the interval of the points
    _, expected = run(tmp_path / "straight", **flags)
    _, run_dir = run(tmp_path / "stopped", before_frame=stop_at(frame), **flags)
    assert run(tmp_path / "stopped", resume=run_dir)[0] == 0
    assert everything(run_dir) == everything(expected)


@pytest.mark.parametrize("flags", [dict(replay_encoding="raw"), dict(replay_encoding="tensor"),
                                   dict(agent_replay_buffer_maximum_length=160), dict(precision="float32")], ids=str)
def test_other_encodings_a_full_replay_memory_and_float32_resume_exactly(flags, tmp_path):
    results = []
    for frame in (None, 200):
        folder = tmp_path / str(frame)
        code, run_dir = run(folder, before_frame=frame and stop_at(frame), **flags)
        if frame:
            assert (code, run(folder, resume=run_dir)[0]) == (143, 0)
        results.append(everything(run_dir))
    assert results[0] == results[1]


def test_frames_are_stored_once_each(tmp_path):
    _, run_dir = run(tmp_path)
    state, frames = dqn.load_checkpoint(run_dir / "checkpoint.pt")
    episodes = state["counters"]["episodes"]
    assert FRAMES <= len(frames) <= FRAMES + episodes + 2


# ---- crashes and full disks ------------------------------------------------------------------------


def in_a_child(folder: Path, limit: int | None = None, **arguments) -> int:
    """run() in a forked process, under a file-size limit if given; returns the child's process number."""
    child = os.fork()
    if child:
        return child
    code = 70  # none of main's
    try:
        # tqdm's lock lies in memory that a fork shares: killed while it draws, the child would keep it from us for ever
        dqn.tqdm.set_lock(threading.RLock())
        if limit:
            import resource

            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
        sys.stderr = sys.stdout = open(folder.parent / "child.log", "a")
        code = run(folder, **arguments)[0]
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(code)


@posix
def test_thirty_kills_while_checkpointing_lose_nothing(tmp_path):
    flags = dict(environment_checkpoint_interval_episodes=1, agent_update_frequency=8,
                 environment_train_frames_max=300)
    folder, rng = tmp_path / "killed", np.random.default_rng(0)
    folder.mkdir()
    started = time.monotonic()
    _, expected = run(tmp_path / "straight", **flags)
    duration, kills, frames = time.monotonic() - started, 0, set()
    while kills < 30:
        run_dir = next(folder.iterdir(), None)
        resume = run_dir if run_dir and (run_dir / "checkpoint.pt").exists() else None
        if run_dir and not resume:
            shutil.rmtree(run_dir)
        child = in_a_child(folder, resume=resume, **({} if resume else flags))
        time.sleep(rng.random() * duration)
        os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
        if os.WIFEXITED(status):  # it was done before the signal: begin another run
            assert os.WEXITSTATUS(status) == 0, (tmp_path / "child.log").read_text()
            shutil.rmtree(next(folder.iterdir()))
            continue
        kills += 1
        checkpoint = next(folder.iterdir(), folder) / "checkpoint.pt"
        saved = checkpoint.exists()
        if saved:
            frames.add(dqn.load_checkpoint(checkpoint)[0]["counters"]["frames"])  # whole, whatever the moment
    assert len(frames) >= 2, frames  # the children got somewhere before they were killed
    _, run_dir = run(folder, resume=checkpoint.parent) if saved else run(tmp_path / "again", **flags)
    assert everything(run_dir) == everything(expected)


@posix
def test_a_full_disk_loses_nothing_and_training_goes_on(tmp_path):
    folder = tmp_path / "full"
    _, run_dir = run(folder, before_frame=stop_at(200))
    before = (run_dir / "checkpoint.pt").read_bytes()
    _, status = os.waitpid(in_a_child(folder, limit=10_000_000, resume=run_dir), 0)
    log = (tmp_path / "child.log").read_text()
    assert os.WEXITSTATUS(status) == 1, log  # the last frames could not be kept, and that is said
    assert log.count("warning: checkpoint.pt could not be written (File too large); the run goes on") > 1
    assert (run_dir / "checkpoint.pt").read_bytes() == before
    assert not (run_dir / "test.json").exists() and not list(run_dir.glob("*.tmp"))
    assert run(folder, resume=run_dir)[0] == 0 and (run_dir / "test.json").exists()
    assert dqn.load_checkpoint(run_dir / "checkpoint.pt")[0]["counters"]["frames"] == FRAMES


@pytest.mark.parametrize("lost", ["q_network.pt", "evaluations.csv", "test.json"])
def test_a_result_that_could_not_be_kept_is_a_failure_that_resuming_mends(tmp_path, capsys, monkeypatch, lost):
    write = dqn.write_atomically

    def refuse(path, content):
        if path.name == lost:
            raise OSError(28, "No space left on device")
        write(path, content)

    monkeypatch.setattr(dqn, "write_atomically", refuse)
    code, run_dir = run(tmp_path, environment_train_frames_max=160, environment_evaluation_interval_episodes=1)
    assert code == 1 and not (run_dir / lost).exists()
    assert f"warning: {lost} could not be written (No space left on device)" in capsys.readouterr().err
    monkeypatch.undo()
    assert run(tmp_path, resume=run_dir)[0] == 0 and (run_dir / lost).exists()


def test_curves_that_cannot_be_written_do_not_end_the_run(tmp_path, capsys, monkeypatch):
    line = "warning: a point of the curves could not be written (No space left on device); the run goes on\n"
    curves = dqn.Curves(tmp_path, 0)

    def refuse(*_, **__):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as full:
        full.setattr(dqn, "SummaryWriter", refuse)  # it writes when it is made
        curves.add({"charts/epsilon": 1.0}, 1)
        assert capsys.readouterr().err == line
    curves.flush()
    monkeypatch.setattr(curves.writer, "add_scalar", refuse)
    curves.add({"charts/epsilon": 1.0}, 1)
    assert capsys.readouterr().err == line
    curves.add({"charts/epsilon": 0.5}, 2)
    curves.flush()
    events = EventAccumulator(str(tmp_path)).Reload()
    assert [(event.step, event.value) for event in events.Scalars("charts/epsilon")] == [(2, 0.5)]


@posix
def test_a_full_disk_shows_no_traceback_of_tensorboards_thread(tmp_path):
    code = """
import resource, sys, time
import dqn_atari as dqn
from pathlib import Path
curves = dqn.Curves(Path(sys.argv[1]), 0)
resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))
for frame in range(200):
    curves.add({"charts/epsilon": 1.0}, frame)
    curves.flush()
    time.sleep(0.005)
"""
    done = subprocess.run([sys.executable, "-c", code, tmp_path], cwd=ALGORITHMS, capture_output=True, text=True)
    line = "warning: a point of the curves could not be written (File too large); the run goes on"
    assert done.returncode == 0 and set(done.stderr.splitlines()) == {line}, done.stderr


@posix
def test_a_second_sigterm_does_not_cut_the_checkpoint_off():
    code = """
import signal
import dqn_atari as dqn
stop = dqn.Stop()
for _ in range(3):
    signal.raise_signal(signal.SIGTERM)
print(stop.signum)
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ALGORITHMS, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, f"{int(signal.SIGTERM)}\n"), done.stderr


@posix
@pytest.mark.parametrize(("signum", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_saves_and_prints_the_command_that_resumes(tmp_path, signum, code):
    process = subprocess.Popen([sys.executable, ALGORITHMS / "dqn_atari.py", "--environment-test-frames", "100"],
                               cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        for line in process.stdout:
            if line.startswith("run "):
                break
        time.sleep(1)
        process.send_signal(signum)
        out, err = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == code and "Traceback" not in err, err
    (run_dir,) = (tmp_path / "runs").iterdir()
    command = [sys.executable, str(ALGORITHMS / "dqn_atari.py"), "--resume", str(Path("runs") / run_dir.name)]
    assert f"go on with: {shlex.join(command)}\n" in out
    frames = int(re.search(r"stopped at frame ([\d,]+)", out)[1].replace(",", ""))
    assert dqn.load_checkpoint(run_dir / "checkpoint.pt")[0]["counters"]["frames"] == frames
    assert torch.load(run_dir / "q_network.pt", weights_only=True)["frames"] == frames


# ---- hostile and mistaken files --------------------------------------------------------------------


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """A run directory that waits to be resumed."""
    code, run_dir = run(tmp_path_factory.mktemp("stopped"), before_frame=stop_at(200), agent_replay_buffer_initial=190)
    assert code == 143
    return run_dir


def refused(run_dir: Path, capsys, *flags: str) -> str:
    """Resume must be refused with one line and exit code 2, and must change no file; returns the line."""
    before = {path.name: path.read_bytes() for path in run_dir.iterdir()}
    capsys.readouterr()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["dqn_atari.py", "--resume", str(run_dir), *flags])
        try:
            dqn.main(dqn.parse_args(dqn.Args))
        except SystemExit as stop:  # pytest.raises would keep main's frame alive, and with it the lock
            code = stop.code
    streams = capsys.readouterr()
    assert code == 2
    assert re.fullmatch(r"error: [^\n]+\n", streams.err) and not streams.out, streams
    assert {path.name: path.read_bytes() for path in run_dir.iterdir()} == before
    return streams.err


@pytest.fixture
def copy(stopped, tmp_path):
    return Path(shutil.copytree(stopped, tmp_path / "copy"))


def test_flags_that_contradict_the_run(copy, capsys):
    line = refused(copy, capsys, "--agent-discount-factor", "0.5")
    assert "--agent-discount-factor" in line and "0.5" in line and "0.99" in line
    assert "--seed 2" in refused(copy, capsys, "--seed", "2")
    line = refused(copy, capsys, "--environment-train-frames-max", "300")
    assert "300" in line and str(FRAMES) in line  # lowered


def test_a_contradiction_equal_to_the_default_is_seen(tmp_path, capsys):
    _, run_dir = run(tmp_path, before_frame=stop_at(20), seed=5)
    line = refused(run_dir, capsys, "--seed", "1")
    assert "--seed 1" in line and "5" in line


def test_a_flag_that_agrees_with_the_run_is_welcome(tmp_path):
    flags = dict(agent_replay_buffer_maximum_length=160)  # below Table 3's initial 100,000, above this run's own
    _, run_dir = run(tmp_path, before_frame=stop_at(20), **flags)
    assert run(tmp_path, resume=run_dir, **flags)[0] == 0


def test_a_finished_run_says_so(tmp_path, capsys):
    _, run_dir = run(tmp_path, environment_train_frames_max=160)
    before = {path.name: path.read_bytes() for path in run_dir.iterdir()}
    assert run(tmp_path, resume=run_dir)[0] == 0
    assert "has finished its 160 frames" in capsys.readouterr().out
    assert {path.name: path.read_bytes() for path in run_dir.iterdir()} == before


def test_half_a_test_is_done_again(tmp_path):
    _, run_dir = run(tmp_path, environment_train_frames_max=160)
    whole = (run_dir / "test.json").read_text()
    (run_dir / "test.json").write_text(whole[:20])
    assert run(tmp_path, resume=run_dir)[0] == 0
    assert json.loads((run_dir / "test.json").read_text())["scores"] == json.loads(whole)["scores"]


def test_a_test_cut_off_after_training_on_is_done(tmp_path):
    _, run_dir = run(tmp_path, environment_train_frames_max=160)
    assert run(tmp_path, resume=run_dir, environment_train_frames_max=200, before_frame=stop_at(200))[0] == 143
    assert json.loads((run_dir / "test.json").read_text())["frames"] == 160
    assert run(tmp_path, resume=run_dir)[0] == 0
    assert json.loads((run_dir / "test.json").read_text())["frames"] == 200


def test_two_processes_cannot_write_one_run(copy, capsys):
    lock = dqn.filelock.FileLock(copy / ".lock")
    with lock:
        assert "another process" in refused(copy, capsys)


@posix
def test_the_lock_of_a_dead_process_is_free(copy):
    child = os.fork()
    if not child:
        try:
            dqn.filelock.FileLock(copy / ".lock").acquire(timeout=0)
            signal.raise_signal(signal.SIGKILL)
        finally:
            os._exit(1)
    assert os.WIFSIGNALED(os.waitpid(child, 0)[1])
    assert run(copy.parent, resume=copy)[0] == 0


class Exploit:
    """Unpickling it makes a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (open, (str(self.path), "w"))


def rewrite(path: Path, change) -> None:
    """Write a checkpoint again with change(state) applied, its frames and checksums right."""
    state, blobs = dqn.load_checkpoint(path)
    change(state)
    with open(path, "wb+") as file:
        torch.save(state, file)
        with zipfile.ZipFile(file, "a") as archive:
            archive.writestr("archive/frames", b"".join(blobs))


def test_going_on_in_another_precision_is_said(copy, capsys):
    def widen(state):
        state["target_network"] = {name: tensor.float() for name, tensor in state["target_network"].items()}

    rewrite(copy / "checkpoint.pt", widen)
    assert run(copy.parent, resume=copy)[0] == 0
    assert "trained in torch.float32 so far, from here in torch.bfloat16" in capsys.readouterr().out


def test_a_file_that_would_run_code_is_refused(copy, capsys, tmp_path):
    state = dqn.load_checkpoint(copy / "checkpoint.pt")[0]
    torch.save(state | {"counters": Exploit(tmp_path / "exploited")}, copy / "checkpoint.pt")
    assert "cannot be resumed from" in refused(copy, capsys)
    (copy / "checkpoint.pt").write_bytes(pickle.dumps(Exploit(tmp_path / "exploited")))
    assert "cannot be resumed from" in refused(copy, capsys)
    assert not (tmp_path / "exploited").exists()


def test_mistaken_files(copy, capsys, tmp_path):
    path = copy / "checkpoint.pt"
    whole = path.read_bytes()
    for content in (b"", whole[: len(whole) // 2], whole[:-1], b"PK\3\4" + b"\0" * 1000, b"text"):
        path.write_bytes(content)
        assert "cannot be resumed from" in refused(copy, capsys)
    path.unlink()
    assert "before its first checkpoint" in refused(copy, capsys)
    for change, words in (
            (lambda state: state.update(format="dqn_atari checkpoint 0"), "dqn_atari checkpoint 0"),
            (lambda state: state["args"].update(env_id="PongNoFrameskip-v4"), "PongNoFrameskip-v4"),
            (lambda state: state["args"].update(agent_history_length=3), "--agent-history-length"),
            (lambda state: state["q_network"].update({"head.bias": torch.zeros(3)}), "q_network"),
            (lambda state: state.pop("optimizer"), "optimizer"),
            (lambda state: state["replay"]["indices"].add_(10**6), "replay")):
        path.write_bytes(whole)
        rewrite(path, change)
        assert words in refused(copy, capsys)
    path.write_bytes(whole)
    (copy / "args.json").write_text('{"env_id": "Pong')
    assert "args.json" in refused(copy, capsys)


def test_two_hundred_bit_flips_never_resume_wrongly(stopped, tmp_path):
    path, rng = tmp_path / "checkpoint.pt", np.random.default_rng(1)
    whole = bytearray((stopped / "checkpoint.pt").read_bytes())
    state, frames = dqn.load_checkpoint(stopped / "checkpoint.pt")
    expected, found = plain(state), 0
    tail = len(whole) - 4096  # half of the flips in the archive's directory at the end, half anywhere
    for i in range(200):
        position = int(rng.integers(tail, len(whole)) if i % 2 else rng.integers(len(whole)))
        whole[position] ^= 1 << int(rng.integers(8))
        path.write_bytes(whole)
        try:
            flipped, flipped_frames = dqn.load_checkpoint(path)
            assert plain(flipped) == expected and flipped_frames == frames  # a bit that means nothing: padding, a date
        except ValueError as error:
            assert "\n" not in str(error)
            found += 1
        whole[:] = (stopped / "checkpoint.pt").read_bytes()
    assert found > 100
