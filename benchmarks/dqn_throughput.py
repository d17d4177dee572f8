"""Frames per second of the DQN scripts beside Stable-Baselines3's, and where a frame's time goes.

    pip install -r requirements.txt -r benchmarks/requirements.txt
    python benchmarks/dqn_throughput.py                 # dqn_atari.py, at both replay ratios
    python benchmarks/dqn_throughput.py --parallel      # dqn_atari_parallel.py, 1 to 32 simulators

The same game, minibatch of 32, replay ratio, learning rate and interval of target copies, ε at
0.01, timed once learning is under way, on an otherwise idle machine. The contenders run in
processes of their own that take turns, 384 frames each while the others wait: all see the same
machine, whose speed may drift. Our scripts are run whole, as their users run them;
Stable-Baselines3's DQN (float32) with its CnnPolicy and its own Atari wrappers, with as many
environments as there are simulators. All are on the CPU and warm up for 5,000 frames without
learning and 1,144 with. Until a process has freed a large block of memory, the C library of Linux
gives an update's memory back to the system after each, at the price of page faults. Our runs free
such a block at their start; Stable-Baselines3 does not, so it is timed as it comes, and once more
after freeing one.

A run of hours can slow down where a benchmark of seconds does not, so a run is also timed whose
optimizer is old: half of the linear layer's units dead, and their moments denormal numbers; and
Adam's step alone, with and without the flag that flushes them. Runs keep the frames per second of
their first and last tenth in test.json.
"""

import atexit
import contextlib
import copy
import dataclasses
import multiprocessing
import os
import queue
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
import tyro
from machine import cpu_name

sys.path.insert(0, str(Path(__file__).parent.parent / "algorithms"))
TURN = 384  # frames: whole steps of 1 to 32 simulators
FILLED = 5_000  # frames before learning starts
WARM_UP = 16 * TURN  # frames, the last 1,144 with learning


@dataclasses.dataclass
class Args:
    frames: int = 5_760
    """frames of each contender that are timed, in whole turns of 384"""
    env_id: str = "PongNoFrameskip-v4"
    """game"""
    parallel: bool = False
    """whether to time dqn_atari_parallel.py, at one update in four"""


class Turns:
    """Lets a process run TURN frames at a time, in turns; keeps the seconds of the turns after
    warm-up."""

    def __init__(self, mine, following):
        self.mine, self.following = mine, following  # semaphores
        self.frames, self.seconds = 0, []
        mine.acquire()
        self.started = time.perf_counter()

    def step(self, frames: int = 1) -> None:
        """To be called after every frame, or after those of several simulators."""
        self.frames += frames
        if self.frames % TURN == 0:
            if self.frames > WARM_UP:
                self.seconds.append(time.perf_counter() - self.started)
            self.following.release()
            self.mine.acquire()
            self.started = time.perf_counter()


def run_script(dqn, args: Args, turns: Turns | None, **flags) -> None:
    """Run dqn_atari.py or dqn_atari_parallel.py; frames are updates of its progress bar."""

    class Bar(dqn.tqdm):
        def update(self, n=1):
            super().update(n)
            turns.step(n)

    if turns:
        dqn.tqdm = Bar
    with tempfile.TemporaryDirectory() as folder:
        dqn.main(dqn.Args(
            env_id=args.env_id, device="cpu", runs_dir=folder, agent_replay_buffer_initial=FILLED,
            environment_train_frames_max=WARM_UP + args.frames, environment_test_frames=1,
            environment_evaluation_interval_episodes=10**9,  # an evaluation has a bar of its own
            checkpoint_interval_minutes=1e9,  # none falls into a turn
            agent_epsilon_greedy_annealing=FILLED, **flags))


def make_old(optimizer: torch.optim.Optimizer, linear: torch.nn.Linear) -> None:
    """As after a run of hours: half of the units of `linear` dead, their moments denormal: written
    as bits, as floats might be flushed on the way."""
    for group in optimizer.param_groups:
        for θ in group["params"]:
            θ.grad = torch.zeros_like(θ)
    optimizer.step()  # makes the moments
    linear.bias.data[::2] = -1e4  # such a unit is 0 in every state, and gets no gradient
    for moments in ("exp_avg", "exp_avg_sq"):
        optimizer.state[linear.weight][moments].view(torch.int32)[::2] = 700_000  # 1e-39


def ours(args: Args, turns: Turns, old: bool = False, **flags) -> None:
    """dqn_atari.py; `old`: with an old optimizer."""
    import dqn_atari

    make_optimizer = dqn_atari.make_optimizer

    def make_old_optimizer(script_args, q_network):
        optimizer = make_optimizer(script_args, q_network)
        make_old(optimizer, q_network.layers[7])
        return optimizer

    if old:
        dqn_atari.make_optimizer = make_old_optimizer
    run_script(dqn_atari, args, turns, **flags)


def ours_parallel(args: Args, turns: Turns | None, ranks: int, rank: int = 0, **flags) -> None:
    """dqn_atari_parallel.py, in `ranks` processes as torchrun starts them."""
    import dqn_atari_parallel

    if ranks > 1:
        os.environ |= {"RANK": str(rank), "WORLD_SIZE": str(ranks), "MASTER_ADDR": "127.0.0.1",
                       "MASTER_PORT": "29876"}
        if rank == 0:
            others = {"ranks": ranks, "rank": 1, **flags}
            multiprocessing.get_context("spawn").Process(
                target=ours_parallel, args=(args, None), kwargs=others).start()
        torch.set_num_threads(1)  # as torchrun does
        all_reduce = dqn_atari_parallel.distributed.all_reduce

        def in_turn(sums: torch.Tensor) -> None:
            if rank == 0:  # it takes its turn here, where the other waits for it
                turns.step(ranks * flags["num_simulators"])
            all_reduce(sums)

        dqn_atari_parallel.distributed.all_reduce = in_turn
    run_script(dqn_atari_parallel, args, turns if ranks == 1 else None, **flags)


def free_a_block() -> None:
    """Of 30 MB, as our runs do at their start."""
    torch.empty(30 * 2**20, dtype=torch.uint8)


def stable_baselines3(args: Args, turns: Turns, agent_update_frequency: int, envs: int = 1,
                      free: bool = False) -> None:
    """Run its DQN; a call of its callback is a frame of each environment. `free`: after
    `free_a_block`."""
    from stable_baselines3 import DQN
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.env_util import make_atari_env
    from stable_baselines3.common.vec_env import SubprocVecEnv, VecFrameStack

    class Clock(BaseCallback):
        def _on_step(self) -> bool:
            turns.step(envs)
            return True

    if free:
        free_a_block()
    same_game = {"frameskip": 1, "repeat_action_probability": 0.0}
    env = make_atari_env(f"ale_py:{args.env_id}", n_envs=envs, seed=1, env_kwargs=same_game,
                         vec_env_cls=SubprocVecEnv if envs > 1 else None)  # ale_py is imported
    frames = WARM_UP + args.frames
    model = DQN("CnnPolicy", VecFrameStack(env, n_stack=4), learning_rate=1e-4, buffer_size=frames,
                learning_starts=FILLED, batch_size=32, target_update_interval=1000,
                train_freq=max(1, agent_update_frequency // envs),
                gradient_steps=max(1, envs // agent_update_frequency),
                exploration_fraction=FILLED / frames, exploration_final_eps=0.01, seed=1,
                device="cpu")
    model.learn(frames, callback=Clock())


def run(name: str, contender: tuple, args: Args, mine, following, results) -> None:
    """What the process of a contender does."""
    function, flags = contender
    turns = Turns(mine, following)
    with open(os.devnull, "w", encoding="utf-8") as nowhere:
        with contextlib.redirect_stdout(nowhere), contextlib.redirect_stderr(nowhere):
            function(args, turns, **flags)
    results.put((name, turns.seconds[: args.frames // TURN]))
    following.release()  # all turns are over: the next may end, too


def side_by_side(args: Args, contenders: dict[str, tuple]) -> dict[str, float]:
    """Frames per second of each contender."""
    spawn = multiprocessing.get_context("spawn")
    results = spawn.Queue()
    ring = [spawn.Semaphore(int(i == 0)) for i in range(len(contenders))]
    children = [
        spawn.Process(target=run, args=(
            name, contender, args, ring[i], ring[(i + 1) % len(ring)], results))
        for i, (name, contender) in enumerate(contenders.items())
    ]
    for child in children:
        child.start()
        atexit.register(child.kill)  # else, after an error, they wait for one another for ever
    found = {}
    while len(found) < len(children):
        with contextlib.suppress(queue.Empty):
            name, seconds = results.get(timeout=1)
            found[name] = TURN / np.mean(seconds)
        if any(child.exitcode for child in children):
            raise SystemExit("error: a contender has failed")
    for child in children:
        child.join()
    return found


def milliseconds(call, repeats: int = 300, before=lambda: None) -> float:
    """Mean time of call(), after 20 calls of warm-up; before() each is not timed."""
    total = 0.0
    for i in range(repeats + 20):
        before()
        started = time.perf_counter()
        call()
        total += (time.perf_counter() - started) * (i >= 20)
    return total / repeats * 1e3


def make_network(num_actions: int = 6):
    """The network as main of dqn_atari.py lays it out on a CPU."""
    import dqn_atari as dqn

    q_network = dqn.QNetwork(4, 84, 84, num_actions).to(memory_format=torch.channels_last)
    q_network.layers[7].__class__ = dqn.OneDNNLinear
    return q_network


def parts(args: Args) -> dict[str, float]:
    """Milliseconds of each part of a frame in dqn_atari.py."""
    import ale_py
    import dqn_atari as dqn

    script_args = dqn.Args(env_id=args.env_id, device="cpu")
    rng = np.random.default_rng(0)
    env = dqn.FrameHistory(dqn.make_env(script_args, rng, training=True), 4)
    replay = dqn.ReplayMemory(FILLED, (4, 84, 84), "cpu")
    q_network = make_network(int(env.action_space.n))
    target_network = copy.deepcopy(q_network).requires_grad_(False)
    optimizer = dqn.make_optimizer(script_args, q_network)
    s, _ = env.reset(seed=1)

    def step() -> None:
        nonlocal s
        a = int(rng.integers(env.action_space.n))
        s_next, r, terminated, truncated, _ = env.step(a)
        replay.add(s, a, r, s_next, terminated)
        s = env.reset()[0] if terminated or truncated else s_next

    def emulate() -> None:
        for _ in range(4):
            env.unwrapped.ale.act(ale_py.Action.NOOP)
        if env.unwrapped.ale.game_over():
            env.unwrapped.ale.reset_game()

    def update(precision: str) -> None:
        dqn.update(q_network, target_network, optimizer, minibatch, 0.99, precision)

    frame = milliseconds(step, FILLED)
    emulator = milliseconds(emulate, 2_000)
    minibatch = replay.gather(rng.integers(len(replay), size=32))
    times = {
        "emulate (the bare emulator)": emulator,
        "preprocess, compress, store": frame - emulator,
        "act": milliseconds(lambda: dqn.epsilon_greedy(q_network, replay.decode([s]), 0.0, rng)),
        "sample": milliseconds(lambda: replay.gather(rng.integers(len(replay), size=32))),
        "update, float32": milliseconds(lambda: update("float32")),
        "update, bfloat16": milliseconds(lambda: update("bfloat16")),
        "of it Adam's step": milliseconds(optimizer.step),
    }
    for network in (q_network, target_network):
        network.layers[7].__class__ = torch.nn.Linear
    return times | {"update, float32, linear layer by MKL": milliseconds(lambda: update("float32"))}


def old_adam_step(flush: bool) -> float:
    """Milliseconds of the step of an old Adam; `flush`: whether denormal numbers count as 0."""
    import dqn_atari as dqn

    torch.set_flush_denormal(flush)
    q_network = make_network()
    optimizer = dqn.make_optimizer(dqn.Args(), q_network)
    return milliseconds(optimizer.step, 100, lambda: make_old(optimizer, q_network.layers[7]))


def in_a_process(call, *args):
    """call(*args) in a process of its own: flags and threads of another do not reach it."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(call, args)


def flushed_parts(args: Args) -> dict[str, float]:
    """`parts` as in a run: denormal numbers flushed before the first parallel work, and a large
    block of memory freed."""
    torch.set_flush_denormal(True)
    free_a_block()
    return parts(args)


def choose_precision() -> str:
    """What dqn_atari.py --precision auto chooses here."""
    import dqn_atari

    torch.set_flush_denormal(True)
    free_a_block()
    args = dqn_atari.Args(device="cpu")
    return dqn_atari.choose_precision(args, make_network(), (4, 84, 84))


def compare_replay_ratios(args: Args) -> None:
    """Stable-Baselines3 and dqn_atari.py, at one update a frame and at one in four."""
    columns, precision = [], in_a_process(choose_precision)
    for frequency in (1, 4):
        same = {"agent_update_frequency": frequency}
        columns.append(side_by_side(args, {
            "Stable-Baselines3": (stable_baselines3, same),
            "Stable-Baselines3, a block freed": (stable_baselines3, same | {"free": True}),
            "dqn_atari.py, float32": (ours, same | {"precision": "float32"}),
            "dqn_atari.py, float32, old": (ours, same | {"precision": "float32", "old": True}),
            f"dqn_atari.py, auto: {precision}": (ours, same | {"precision": precision}),
        }))
    title = ("update every frame", "update every 4th")
    print(f"\n{'frames a second':<38}{title[0]:>22}{title[1]:>22}")
    for name in columns[0]:
        rates = [f"{c[name]:.1f} ({c[name] / c['Stable-Baselines3']:.2f})" for c in columns]
        print(f"{name:<38}{rates[0]:>22}{rates[1]:>22}")


def compare_simulators(args: Args, times: dict[str, float]) -> None:
    """dqn_atari_parallel.py with 1 to 32 simulators, and with two processes of 4."""
    precision = in_a_process(choose_precision)
    same = {"agent_update_frequency": 4}
    chosen = same | {"precision": precision}
    contenders = {"dqn_atari.py": (ours, chosen)}
    for n in (1, 2, 4, 8, 16, 32):
        flags = chosen | {"num_simulators": n, "ranks": 1}
        contenders[f"dqn_atari_parallel.py, {n} simulators"] = (ours_parallel, flags)
        if n <= 8:  # each of its environments takes hundreds of megabytes
            sb3 = stable_baselines3, same | {"envs": n}
            contenders[f"Stable-Baselines3, {n} environments"] = sb3
    flags = chosen | {"num_simulators": 4, "ranks": 2}
    contenders["dqn_atari_parallel.py, 2 ranks of 4"] = (ours_parallel, flags)
    found = side_by_side(args, contenders)
    title = "update every 4th frame"
    print(f"\n{'frames a second, ours in ' + precision:<38}{title:>28}")
    for name in contenders:
        print(f"{name:<38}{found[name]:>19.1f} ({found[name] / found['dqn_atari.py']:.2f})")
    emulation = times["emulate (the bare emulator)"] + times["preprocess, compress, store"]
    learning = (times["sample"] + times[f"update, {precision}"]) / 4
    frame = {"emulation": emulation, "acting": times["act"], "learning": learning}
    shares = [f"{name} {ms / sum(frame.values()):.0%}" for name, ms in frame.items()]
    print(f"of a frame of dqn_atari.py: {', '.join(shares)}")
    print(f"extrapolated: with cores enough for the simulators and acting, learning alone is left: "
          f"{1000 / learning:.0f} frames a second")


def main(args: Args) -> None:
    """Print where a frame's time goes, then the contenders side by side."""
    import stable_baselines3  # noqa: F401  it is wanted later: its absence is to be known now

    args.frames = max(1, args.frames // TURN) * TURN
    print(f"{args.env_id}; {cpu_name()}, {os.cpu_count()} cores; PyTorch {torch.__version__}\n")
    print("milliseconds")
    times = in_a_process(flushed_parts, args)
    for name, value in times.items():
        print(f"{name:<38}{value:>10.2f}", flush=True)
    for name, flush in (("Adam's step when old", True), ("  denormal numbers not flushed", False)):
        print(f"{name:<38}{in_a_process(old_adam_step, flush):>10.2f}", flush=True)
    if args.parallel:
        compare_simulators(args, times)
    else:
        compare_replay_ratios(args)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__.split("\n\n")[0]))
