"""dqn_atari_parallel.py: simulators and processes that never mix, exact counts, one θ, and an end without orphans."""

import copy
import json
import os
import shlex
import signal
import subprocess
import sys
import time
import uuid
from pathlib import Path

import dqn_atari as serial
import dqn_atari_parallel as parallel
import numpy as np
import pytest
import torch
from conftest import ALGORITHMS
from gymnasium.wrappers import TimeLimit

BREAKOUT, FRAME_CAP = "BreakoutNoFrameskip-v4", 180
SHORT = dict(device="cpu", env_id=BREAKOUT, environment_train_frames_max=300, agent_replay_buffer_initial=100,
             agent_replay_buffer_maximum_length=2000, optimizer_minibatch_size=8, agent_update_frequency=4,
             environment_test_frames=20)
linux = pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="looks for processes in /proc")


def flags(**changed) -> list[str]:
    """Of a command line."""
    return [f"--{name.replace('_', '-')}={value}" for name, value in (SHORT | changed).items()]


def capped(env):
    """Games that are longer than FRAME_CAP are truncated; the lives go on inside them."""
    env.env = TimeLimit(env.env, FRAME_CAP)
    return env


def make_capped_simulator(*arguments):
    return capped(make_simulator(*arguments))


make_simulator = parallel.make_simulator


class Run:
    """main() in this process, watched: `memory`, `no_op_rngs` as they were at the start, one entry of `updates` per
    update and one of `steps` per step."""

    def __init__(self, folder: Path, **changed):
        self.updates, self.steps, run = [], [], self
        vector_env, original_update = parallel.AsyncVectorEnv, parallel.update

        class Memory(parallel.ReplayShare):
            def __init__(self, *arguments):
                super().__init__(*arguments)
                run.memory = self

        class Bar(parallel.tqdm):
            def update(self, n=1):
                super().update(n)
                run.steps.append((n, run.memory.added, len(run.updates)))

        def watched_env(makers, **settings):
            run.no_op_rngs = [copy.deepcopy(maker.args[1]) for maker in makers]
            run.env = vector_env(makers, **settings)
            return run.env

        def update(q_network, target_network, optimizer, *rest):
            before = q_network.head.weight.detach().clone()
            result = original_update(q_network, target_network, optimizer, *rest)
            run.updates.append({"frames": len(run.memory), "target": target_network.head.weight.clone(),
                                "before": before, "after": q_network.head.weight.detach().clone(),
                                "steps_of_adam": int(next(iter(optimizer.state.values()))["step"])})
            return result

        handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
        with pytest.MonkeyPatch.context() as patch:
            for name, value in {"ReplayShare": Memory, "tqdm": Bar, "AsyncVectorEnv": watched_env, "update": update,
                                "make_simulator": make_capped_simulator}.items():
                patch.setattr(parallel, name, value)
            args = parallel.Args(**(SHORT | {"runs_dir": str(folder)} | changed))
            parallel.main(args)
        for number, handler in handlers.items():
            signal.signal(number, handler)
        (self.run_dir,) = folder.iterdir()


def read_checkpoint(run_dir: Path) -> dict:
    return torch.load(run_dir / "checkpoint.pt", weights_only=True)


# ---- simulators ----


@pytest.mark.parametrize("simulators", [1, 3, 4])
def test_every_transition_is_that_of_a_serial_replay(tmp_path, simulators):
    run = Run(tmp_path, num_simulators=simulators, environment_train_frames_max=600 * simulators,
              agent_epsilon_greedy_epsilon_final=1.0, agent_replay_buffer_initial=2000 * simulators,
              agent_replay_buffer_maximum_length=2000 * simulators)
    s, a, r, s_next, terminal = run.memory.gather(np.arange(len(run.memory)))
    assert len(s) == 600 * simulators
    ends = []
    for i, rng in enumerate(run.no_op_rngs):
        env = serial.FrameHistory(capped(serial.make_env(serial.Args(**SHORT), rng, training=True)), 4)
        state, _ = env.reset(seed=1 + i)
        for j in range(i, len(s), simulators):
            assert torch.equal(s[j], run.memory.decode(state)), (i, j)
            state, reward, terminated, truncated, info = env.step(int(a[j]))
            assert torch.equal(s_next[j], run.memory.decode(state)), (i, j)
            assert (float(r[j]), bool(terminal[j])) == (reward, terminated), (i, j)
            if terminated or truncated:
                ends.append("truncated" if truncated else "game" if "episode" in info else "life")
                state, _ = env.reset()
    assert set(ends) == {"life", "game", "truncated"}, ends
    assert json.loads((run.run_dir / "test.json").read_text())["episodes"] == len(ends)


def test_batch_of_actions_is_greedy_for_each_state():
    q_network = parallel.QNetwork(4, 84, 84, 6)
    states = torch.randint(256, (5, 4, 84, 84), dtype=torch.uint8)
    states[2:] //= 8
    q_network.head.weight.data *= 100
    rng = np.random.default_rng(0)
    wanted = [serial.epsilon_greedy(q_network, state, 0.0, rng) for state in states]
    assert parallel.epsilon_greedy_batch(q_network, states, 0.0, rng).tolist() == wanted
    many = np.array([parallel.epsilon_greedy_batch(q_network, states, 0.6, rng) for _ in range(400)])
    assert abs((many == wanted).mean() - (0.4 + 0.6 / 6)) < 0.04
    assert len(set(map(tuple, many))) > 100  # each simulator draws for itself


# ---- counts ----


@pytest.mark.parametrize(("simulators", "frequency"), [(3, 4), (4, 1)])
def test_updates_and_target_copies_are_exact(tmp_path, simulators, frequency):
    run = Run(tmp_path, num_simulators=simulators, agent_update_frequency=frequency, environment_train_frames_max=240,
              optimizer_q_network_parameter_update_interval_frames=50)
    start = -(-100 // simulators) * simulators  # 100 transitions, in whole steps
    frames = np.arange(simulators, 240 + simulators, simulators)
    assert run.steps == [(simulators, n, max(0, n - start) // frequency) for n in frames]
    assert min(update["frames"] for update in run.updates) >= 100
    done = [0, *(updates for _, _, updates in run.steps)]
    copied = run.updates[0]["before"]
    for step, n in enumerate(frames):  # of the updates at step n, the next step's see the copy
        for update in run.updates[done[step] : done[step + 1]]:
            assert torch.equal(update["target"], copied), n
        if n // 50 > (n - simulators) // 50 and done[step + 1]:
            copied = run.updates[done[step + 1] - 1]["after"]
    result = json.loads((run.run_dir / "test.json").read_text())
    assert (result["frames"], result["updates"]) == (240, len(run.updates))


# ---- processes ----

RANK = """
import os, sys
import torch
sys.path.insert(0, sys.argv.pop(1))
folder = sys.argv.pop(1)
import dqn_atari_parallel as parallel
update, memory, seen = parallel.update, parallel.ReplayShare, []

def watched(q_network, target_network, optimizer, minibatch, *rest):
    θ = [x.detach().clone() for x in q_network.parameters()]
    result = update(q_network, target_network, optimizer, minibatch, *rest)
    seen.append({"θ": θ, "minibatch": minibatch, "gradient": [x.grad.clone() for x in q_network.parameters()],
                 "target": [x.clone() for x in target_network.parameters()], "pid": os.getpid()})
    if len(seen) == 8:
        path = f"{folder}/rank{os.environ['RANK']}"
        torch.save(seen, path + ".tmp")
        os.rename(path + ".tmp", path)
    return result

if __name__ == "__main__":
    parallel.update = watched
    parallel.main(parallel.read_args())
"""


def processes_of(mark: str) -> list[int]:
    """Living processes with this mark in their environment."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            zombie = (path / "stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
            if not zombie and f"MARK={mark}\0".encode() in (path / "environ").read_bytes():
                found.append(int(path.name))
        except OSError:
            pass  # it has ended
    return found


def wait_until(condition, seconds: float = 60):
    """Returns what the condition does, once that is something."""
    limit = time.monotonic() + seconds
    while not (value := condition()):
        assert time.monotonic() < limit, condition
        time.sleep(0.05)
    return value


class Command:
    """A run of a command line, with a mark on all its processes."""

    def __init__(self, folder: Path, *command, **changed):
        self.mark, self.folder = uuid.uuid4().hex, folder
        command = [*command, *flags(runs_dir=folder / "runs", environment_train_frames_max=10**6,
                                    checkpoint_interval_minutes=0.005, num_simulators=2, **changed)]
        self.process = subprocess.Popen(list(map(str, command)), cwd=folder, env=os.environ | {"MARK": self.mark},
                                        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)

    def run_dir(self) -> Path:
        """The run directory, once it has a checkpoint."""
        return wait_until(lambda: list(self.folder.glob("runs/*/checkpoint.pt")))[0].parent

    def end(self) -> tuple[int, str, str]:
        """Wait for its end: exit code, output, errors. No process may be left."""
        output, errors = self.process.communicate(timeout=60)
        wait_until(lambda: not processes_of(self.mark), 10)
        return self.process.returncode, output, errors


@pytest.fixture(scope="module")
def two_ranks(tmp_path_factory):
    """What each of two ranks saw in its first updates; then one is killed: exit code, errors, checkpoint."""
    folder = tmp_path_factory.mktemp("ranks")
    (folder / "rank.py").write_text(RANK, encoding="utf-8")
    run = Command(folder, Path(sys.executable).with_name("torchrun"), "--nproc-per-node", 2, folder / "rank.py",
                  ALGORITHMS, folder, optimizer_q_network_parameter_update_interval_frames=110)
    run_dir = run.run_dir()
    files = [folder / "rank0", folder / "rank1"]
    wait_until(lambda: all(file.exists() for file in files))
    ranks = [torch.load(file, weights_only=True) for file in files]
    os.kill(ranks[1][0]["pid"], signal.SIGKILL)
    code, _, errors = run.end()
    return ranks, code, errors, run_dir


@linux
def test_ranks_have_one_θ_and_their_own_minibatches(two_ranks):
    (first, second), *_ = two_ranks
    for mine, yours in zip(first, second, strict=True):
        for name in ("θ", "gradient", "target"):
            assert all(torch.equal(x, y) for x, y in zip(mine[name], yours[name], strict=True)), name
        assert not torch.equal(mine["minibatch"][0], yours["minibatch"][0])
    assert not torch.equal(first[0]["θ"][0], first[-1]["θ"][0])


@linux
def test_gradient_is_the_mean_of_the_ranks(two_ranks):
    (first, second), *_ = two_ranks
    for mine, yours in zip(first, second, strict=True):
        both = [torch.cat(pair) for pair in zip(mine["minibatch"], yours["minibatch"], strict=True)]
        assert len(both[0]) == SHORT["optimizer_minibatch_size"]
        networks = [parallel.QNetwork(4, 84, 84, 4) for _ in range(2)]
        for network, name in zip(networks, ("θ", "target"), strict=True):
            for parameter, value in zip(network.parameters(), mine[name], strict=True):
                parameter.data = value
        parallel.update(*networks, torch.optim.SGD(networks[0].parameters(), lr=0.0), both, 0.99, "float32")
        for parameter, gradient in zip(networks[0].parameters(), mine["gradient"], strict=True):
            torch.testing.assert_close(gradient, parameter.grad / 2, rtol=1e-4, atol=1e-5)


@linux
def test_killed_rank_ends_the_run(two_ranks):
    _, code, errors, run_dir = two_ranks
    assert code != 0
    assert "error: another process of the run has died" in errors
    assert read_checkpoint(run_dir)["counters"]["frames"] > 0


@linux
def test_killed_simulator_ends_the_run(tmp_path):
    run = Command(tmp_path, sys.executable, ALGORITHMS / "dqn_atari_parallel.py")
    run_dir = run.run_dir()
    simulators = [pid for pid in processes_of(run.mark) if os.getsid(pid) == pid]
    assert len(simulators) == 2
    os.kill(simulators[0], signal.SIGKILL)
    code, _, errors = run.end()
    assert code == 1
    assert "Traceback" not in errors and "error: a simulator has died" in errors
    assert read_checkpoint(run_dir)["counters"]["frames"] > 0


@linux
def test_stopped_run_goes_on_after_its_memory_is_filled(tmp_path, monkeypatch):
    run = Command(tmp_path, sys.executable, ALGORITHMS / "dqn_atari_parallel.py")
    run_dir = run.run_dir()
    wait_until(lambda: read_checkpoint(run_dir)["counters"]["updates"])
    run.process.terminate()
    code, output, errors = run.end()
    assert code == 128 + signal.SIGTERM, errors
    saved = read_checkpoint(run_dir)
    frames, updates = saved["counters"]["frames"], saved["counters"]["updates"]

    monkeypatch.setattr(sys, "argv", shlex.split(output.splitlines()[-1].split("go on with: python ")[1]))
    args = vars(parallel.read_args()) | {"environment_train_frames_max": frames + 140}
    resumed = Run(run_dir.parent, **args)
    first = resumed.updates[0]
    assert first["frames"] >= 100 and first["steps_of_adam"] == updates + 1
    assert torch.equal(first["before"], saved["q_network"]["head.weight"])
    counters = read_checkpoint(run_dir)["counters"]
    assert (counters["frames"], counters["updates"]) == (frames + 140, updates + (140 - 100) // 4)
