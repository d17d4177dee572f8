"""dqn_atari_parallel.py: nothing mixes, counts are exact, ranks have one θ, nobody is orphaned."""

import contextlib
import copy
import itertools
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import dqn_atari as serial
import dqn_atari_parallel as parallel
import numpy as np
import pytest
import test_dqn_atari
import torch
from conftest import ALGORITHMS
from gymnasium.wrappers import TimeLimit
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

PYTHON = sys.executable, ALGORITHMS / "dqn_atari_parallel.py"
SHORT = {name: value for name, value in test_dqn_atari.SHORT.items() if name != "threads"} | dict(
    device="cpu", environment_train_frames_max=10**7, environment_test_frames=20,
    environment_evaluation_interval_episodes=1, agent_replay_buffer_maximum_length=2000,
    optimizer_q_network_parameter_update_interval_frames=10**6)
make_simulator = parallel.make_simulator


def capped(env):
    env.env = TimeLimit(env.env, 180)  # frames; some games of random play are longer
    return env


def make_capped_simulator(*arguments):
    return capped(make_simulator(*arguments))


class Run:
    """main() in this process: memory, no-op generators at the start, updates, acting, tests."""

    def __init__(self, folder: Path, precision="float32", **flags):
        run, self.updates, self.steps, self.acted, self.evaluated = self, [], [], [], []
        make_memory, make_envs = parallel.ReplayShare, parallel.AsyncVectorEnv
        class Bar(parallel.tqdm):
            def update(self, n=1):
                super().update(n)
                run.steps.append((n, run.memory.added, len(run.updates)))

        def envs(makers, **settings):
            run.no_op_rngs = [copy.deepcopy(maker.args[1]) for maker in makers]
            return make_envs(makers, **settings)

        def update(q_network, target_network, optimizer, *rest):
            before = q_network.head.weight.detach().clone()
            assert (optimizer.defaults["lr"], *rest[1:]) == (2e-4, 0.9, precision)
            result = serial.update(q_network, target_network, optimizer, *rest)
            run.updates.append({
                "frames": len(run.memory), "s": rest[0][0], "before": before,
                "target": target_network.head.weight.clone(),
                "after": q_network.head.weight.detach().clone(),
                "adam": int(next(iter(optimizer.state.values()))["step"])})
            return result

        def act(q_network, states, epsilon, rng):
            run.acted.append((q_network.head.weight.requires_grad, states, epsilon))
            return greedy(q_network, states, epsilon, rng)

        def evaluate(args, q_network, decode, number):
            run.evaluated.append((q_network.head.weight.requires_grad, number))
            return serial.evaluate(args, q_network, decode, number)
        greedy = parallel.epsilon_greedy_batch
        with pytest.MonkeyPatch.context() as patch:
            spies = dict(AsyncVectorEnv=envs, tqdm=Bar, update=update,
                         make_simulator=make_capped_simulator, epsilon_greedy_batch=act,
                         evaluate=evaluate, ReplayShare=lambda *arguments: setattr(
                             run, "memory", make_memory(*arguments)) or run.memory)
            for name, spy in spies.items():
                patch.setattr(parallel, name, spy)
            patch.setattr(signal, "signal", lambda *_: None)  # Ctrl-C still ends pytest
            flags = SHORT | dict(runs_dir=str(folder), precision=precision) | flags
            parallel.main(parallel.Args(**flags))
        self.result = json.loads(next(folder.glob("*/test.json")).read_text())


def read_checkpoint(run_dir: Path) -> dict:
    return torch.load(run_dir / "checkpoint.pt", weights_only=True)


@pytest.mark.parametrize("simulators", [1, 3, 4])
def test_every_transition_is_that_of_a_serial_replay(tmp_path, simulators):
    run = Run(tmp_path, num_simulators=simulators, environment_train_frames_max=400 * simulators,
              agent_replay_buffer_initial=2400, agent_replay_buffer_maximum_length=2400,
              environment_evaluation_interval_episodes=5, seed=simulators,
              agent_epsilon_greedy_epsilon_evaluation=1.0, environment_test_frames=400)
    decode = serial.ReplayMemory(1, (4, 44, 52), "cpu").decode
    s, a, r, s_next, terminal = run.memory.gather(np.arange(400 * simulators))
    fresh = np.random.default_rng([simulators, 0, 0]).spawn(2 + simulators)
    assert a[:simulators].tolist() == fresh[0].integers(4, size=simulators).tolist()  # ε is 1
    assert torch.equal(torch.cat([states for _, states, _ in run.acted]), s)
    ends, games = [], []
    for i, rng in enumerate(run.no_op_rngs):
        assert rng.bit_generator.state == fresh[2 + i].bit_generator.state
        env = serial.FrameHistory(capped(serial.make_env(serial.Args(**SHORT), rng, True)), 4)
        state, _ = env.reset(seed=simulators + i)
        for j in range(i, len(s), simulators):
            assert torch.equal(s[j], decode([state])[0]), (i, j)
            state, reward, terminated, truncated, info = env.step(int(a[j]))
            assert torch.equal(s_next[j], decode([state])[0]), (i, j)
            assert (float(r[j]), bool(terminal[j])) == (reward, terminated), (i, j)
            if "episode" in info:
                games.append((j - i + simulators, info["episode"]["r"]))
            if terminated or truncated:
                ends.append("cap" if truncated else "game" if "episode" in info else "life")
                state, _ = env.reset()
    assert set(ends) == {"life", "game", "cap"}, ends
    rows = next(tmp_path.glob("*/evaluations.csv")).read_text().count("\n") - 1
    assert (run.memory.added, run.result["episodes"], rows) == (len(s), len(ends), len(ends) // 5)
    assert run.evaluated == [(True, number) for number in (*range(1, rows + 1), 0)]
    unfinished = run.result["unfinished_score_and_length"][1]
    assert 0 < sum(run.result["lengths"]) == 400 - unfinished
    events = EventAccumulator(str(next(tmp_path.iterdir()))).Reload()
    found = [(event.step, event.value) for event in events.Scalars("charts/episodic_return")]
    assert sorted(found) == sorted(games)


def test_batch_of_actions_is_greedy_for_each_state():
    torch.manual_seed(0)
    q_network = parallel.QNetwork(4, 84, 84, 6)
    states = torch.randint(256, (5, 4, 84, 84), dtype=torch.uint8)
    q_network.head.weight.data *= 100
    q_network.head.bias.data -= q_network(states).mean(dim=0).detach()  # states differ in actions
    rng = np.random.default_rng(0)
    wanted = [serial.epsilon_greedy(q_network, state, 0.0, rng) for state in states.split(1)]
    assert parallel.epsilon_greedy_batch(q_network, states, 0.0, rng).tolist() == wanted
    assert len(set(wanted)) > 1
    many = [parallel.epsilon_greedy_batch(q_network, states, 0.6, rng) for _ in range(400)]
    greedy = np.array(many) == wanted  # (400, 5)
    assert abs(greedy.mean() - (0.4 + 0.6 / 6)) < 0.04
    assert len({*map(tuple, many)}) > 280 and len(np.unique(many)) == 6  # each draws for itself


@pytest.mark.parametrize("simulators,frequency,precision", [(3, 4, "bfloat16"), (4, 1, "float32")])
def test_updates_and_target_copies_are_exact(tmp_path, simulators, frequency, precision):
    run = Run(tmp_path, num_simulators=simulators, agent_update_frequency=frequency,
              environment_train_frames_max=240, agent_replay_buffer_maximum_length=110,
              optimizer_q_network_parameter_update_interval_frames=50, precision=precision)
    frames = range(simulators, 240 + simulators, simulators)
    first = min(n for n in frames if n >= 100) // frequency  # it has no update yet
    assert run.steps == [(simulators, n, max(0, n // frequency - first)) for n in frames]
    assert (run.result["frames"], run.result["updates"]) == (240, len(run.updates))
    epsilons = [serial.epsilon_at(n - simulators, serial.Args()) for n in frames]
    assert [(θ, epsilon) for θ, _, epsilon in run.acted] == [(True, x) for x in epsilons]
    assert len({s.numpy().tobytes() for update in run.updates for s in update["s"]}) > 125
    target, done = (torch.manual_seed(1), serial.QNetwork(4, 44, 52, 4).head.weight)[1], 0
    for _, n, updates in run.steps:
        for update in run.updates[done:updates]:
            assert torch.equal(update["target"], target), n
        if n // 50 > (n - simulators) // 50 and updates:  # it has passed a multiple of 50
            target = run.updates[updates - 1]["after"]
        done = updates


RANK = """
import os, sys, torch
sys.path.insert(0, sys.argv.pop(1))
import dqn_atari_parallel as parallel
update, seen, make, capacities = parallel.update, [], parallel.ReplayShare, []
def watched(q_network, target_network, optimizer, minibatch, *rest):
    seen.append({"pid": os.getpid(), "minibatch": minibatch, "tiny": float(torch.tensor(1e-39) / 2),
                 "capacity": capacities[0],
                 "θ": [x.detach().clone() for x in q_network.parameters()],
                 "target": [x.clone() for x in target_network.parameters()]})
    result = update(q_network, target_network, optimizer, minibatch, *rest)
    seen[-1]["gradient"] = [x.grad.clone() for x in q_network.parameters()]
    if len(seen) == 8:
        parallel.write_file(parallel.Path(f"log{os.getenv('RANK')}"), lambda p: torch.save(seen, p))
    return result
if __name__ == "__main__":
    parallel.update = watched
    parallel.ReplayShare = lambda *a: capacities.append(a[0]) or make(*a)
    parallel.main(parallel.read_args())
"""


def wait_until(condition):
    limit = time.monotonic() + 300
    while not (value := condition()):
        assert time.monotonic() < limit
        time.sleep(0.05)
    return value


class Command:
    """A command line's run, marked in the environment of its processes."""

    def __init__(self, folder: Path, *command):
        if not Path("/proc/self/environ").exists():
            pytest.skip("finds processes in /proc")
        self.mark, self.folder = f"MARK={time.time_ns()}", folder
        flags = SHORT | dict(runs_dir="runs", checkpoint_interval_minutes=0.005, num_simulators=2)
        command = [*map(str, command), *test_dqn_atari.as_flags(flags)]
        self.process = subprocess.Popen(
            command, cwd=folder, env=os.environ | dict([self.mark.split("=")]),
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, encoding="utf-8")

    def run_dir(self) -> Path:
        return wait_until(lambda: list(self.folder.glob("runs/*/checkpoint.pt")))[0].parent

    def processes(self) -> list[int]:
        found = []
        for path in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):  # it has ended
                if self.mark.encode() in (path / "environ").read_bytes():  # empty for a zombie
                    started = (path / "stat").read_text().rpartition(")")[2].split()[19]
                    found.append((int(started), int(path.name)))
        return [pid for _, pid in sorted(found)]  # the oldest first

    def end(self) -> tuple[int, str, str]:
        """Wait for the end of all its processes: exit code, output, errors."""
        output, errors = self.process.communicate(timeout=300)
        wait_until(lambda: not self.processes())
        return self.process.returncode, output, errors


def start_two_ranks(folder: Path, *flags) -> tuple[Command, Path, list, list]:
    """A run of two ranks with a checkpoint of some updates, and what each saw in its first 8."""
    (folder / "rank.py").write_text(RANK, encoding="utf-8")
    torchrun = Path(sys.executable).with_name("torchrun"), "--standalone", "--nproc-per-node", 2
    for file in folder.glob("log?"):
        file.unlink()
    run = Command(folder, *torchrun, folder / "rank.py", ALGORITHMS, *flags)
    run_dir, files = run.run_dir(), [folder / "log0", folder / "log1"]
    wait_until(lambda: all(map(Path.exists, files)))
    wait_until(lambda: read_checkpoint(run_dir)["counters"]["updates"])
    return run, run_dir, *[torch.load(file, weights_only=True) for file in files]


def test_ranks_stop_together_resume_and_have_one_θ_and_the_mean_gradient(tmp_path):
    run, run_dir, *logs = start_two_ranks(tmp_path)
    os.kill(logs[1][0]["pid"], signal.SIGTERM)  # a signal to one stops both
    code, output, errors = run.end()
    assert code != 0 and "to go on: --resume" in output and "has died" not in errors
    saved = read_checkpoint(run_dir)
    run, _, first, second = start_two_ranks(tmp_path, "--resume", run_dir)
    assert all(map(torch.equal, first[0]["θ"], saved["q_network"].values()))
    os.kill(second[0]["pid"], signal.SIGKILL)
    code, _, errors = run.end()
    assert code != 0 and "error: a process of the run has died" in errors
    counters = {"frames": 0, "updates": 0}, saved["counters"], read_checkpoint(run_dir)["counters"]
    for old, new in itertools.pairwise(counters):  # totals over the ranks; 100 frames fill 𝒟
        frames = max(0, new["frames"] - old["frames"] - 100)
        assert new["updates"] - old["updates"] == frames // 4
    networks = [parallel.QNetwork(4, 44, 52, 4) for _ in range(2)]
    for mine, yours in zip(logs[0] + first, logs[1] + second, strict=True):
        for name in ("θ", "gradient", "target"):
            assert all(map(torch.equal, mine[name], yours[name])), name
        assert mine["tiny"] == 0 and mine["capacity"] == yours["capacity"] == 2000 // 2
        assert not torch.equal(mine["minibatch"][0], yours["minibatch"][0])
        both = [torch.cat(pair) for pair in zip(mine["minibatch"], yours["minibatch"], strict=True)]
        assert len(both[0]) == 8
        for network, name in zip(networks, ("θ", "target"), strict=True):
            for parameter, value in zip(network.parameters(), mine[name], strict=True):
                parameter.data = value
        still = torch.optim.SGD(networks[0].parameters(), lr=0.0)
        parallel.update(*networks, still, both, 0.9, "float32")
        for parameter, gradient in zip(networks[0].parameters(), mine["gradient"], strict=True):
            torch.testing.assert_close(gradient, parameter.grad / 2, rtol=1e-4, atol=1e-5)


def test_killed_simulator_ends_the_run(tmp_path):
    run = Command(tmp_path, *PYTHON)
    run_dir = run.run_dir()
    os.kill(run.processes()[-1], signal.SIGKILL)  # simulators start last
    code, _, errors = run.end()
    assert code == 1 and "error: a process of the run" in errors and "Traceback" not in errors
    assert read_checkpoint(run_dir)["counters"]["frames"] > 0


def test_stopped_run_goes_on_after_its_memory_is_filled(tmp_path, monkeypatch):
    run = Command(tmp_path, *PYTHON)
    run_dir, both = run.run_dir(), ("updates", "evaluations")
    wait_until(lambda: all(map(read_checkpoint(run_dir)["counters"].get, both)))
    for pid in reversed(run.processes()):  # Ctrl-C reaches all; here simulators first
        os.kill(pid, signal.SIGINT)
        time.sleep(0.2)
    code, output, _ = run.end()
    assert code == 128 + signal.SIGINT and not (run_dir / "test.json").exists()
    saved = read_checkpoint(run_dir)
    frames, updates = saved["counters"]["frames"], saved["counters"]["updates"]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", output.splitlines()[-1].split()[4:])
    flags = vars(parallel.read_args()) | {"environment_train_frames_max": frames + 140, "seed": 2}
    first = Run(run_dir.parent, **flags).updates[0]  # seed 2: another θ₀
    assert first["frames"] >= 100 and first["adam"] == updates + 1
    for seen, name in (("before", "q_network"), ("target", "target_network")):
        assert torch.equal(first[seen], saved[name]["head.weight"])
    counters = read_checkpoint(run_dir)["counters"]
    assert (counters["frames"], counters["updates"]) == (frames + 140, updates + (140 - 100) // 4)
    assert counters["evaluations"][0]["frames"] <= frames  # what it knew is kept
    saved["q_network"]["head.bias"][0] = torch.nan
    torch.save(saved, run_dir / "checkpoint.pt")
    with pytest.raises(SystemExit, match="NaN"):
        Run(run_dir.parent, **flags)
    os.truncate(run_dir / "checkpoint.pt", 5000)
    with pytest.raises(SystemExit, match="cannot be resumed"):
        parallel.main(parallel.Args(**flags))
