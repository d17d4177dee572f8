"""Does an update in bfloat16 learn what an update in float32 learns?

    python benchmarks/precision.py

The same transitions (random play), the same minibatches, the same initial weights: `updates` updates of dqn_atari.py in
each precision, for each seed, θ⁻ copied at every 250th. What was learnt is judged in float32 on transitions that
neither saw: the mean Huber loss against the targets of the network's own copy, and the mean of max Q. If the difference
between the precisions is of the size of the difference between seeds, the precision is harmless here. That says
something only where the loss is below that of Q = 0, which is printed first: a network that has learnt nothing.
"""

import copy
import dataclasses

import numpy as np
import torch
import torch.nn.functional as F
import tyro
from replay_memory import dqn, play
from tqdm import trange


@dataclasses.dataclass
class Args:
    game: str = "Pong"
    """The game."""
    transitions: int = 10_000
    """Transitions of random play to learn from; another tenth is held out."""
    updates: int = 2_000
    """Updates in each precision, 5 or more."""
    seeds: int = 3
    """Initial weights and orders of minibatches."""


@torch.no_grad()
def judge(q_network, target_network, held_out: tuple, discount: float) -> tuple[float, float]:
    """Mean Huber loss and mean max Q of a float32 network on held-out transitions."""
    s, a, r, s_next, terminal = held_out
    y = r + discount * ~terminal * target_network(s_next).amax(dim=1)
    q = q_network(s)
    return F.huber_loss(q.gather(1, a.unsqueeze(1)).squeeze(1), y).item(), q.amax(dim=1).mean().item()


def learn(args: Args, seed: int, precision: torch.dtype, memory, num_actions: int) -> list[tuple[float, float]]:
    """Judgements after each fifth of the updates."""
    script_args, rng = dqn.Args(), np.random.default_rng(seed)
    torch.manual_seed(seed)
    q_network = dqn.QNetwork(4, 84, 84, num_actions)
    dqn.initialize_orthogonal(q_network)
    optimizer = dqn.make_optimizer(script_args, q_network)
    working_network = dqn.working_copy(q_network, precision)
    target_network = copy.deepcopy(working_network).requires_grad_(False)
    held_out = memory.gather(np.arange(args.transitions, len(memory)))
    judgements = []
    for i in trange(1, args.updates + 1, desc=f"seed {seed}, {precision}", leave=False):
        minibatch = memory.gather(rng.integers(args.transitions, size=script_args.optimizer_minibatch_size))
        dqn.update(q_network, working_network, target_network, optimizer, minibatch,
                   script_args.agent_discount_factor)
        if i % 250 == 0:
            target_network.load_state_dict(q_network.state_dict())
        if i % max(args.updates // 5, 1) == 0:
            target = copy.deepcopy(target_network).float()
            judgements.append(judge(q_network, target, held_out, script_args.agent_discount_factor))
    return judgements


def main(args: Args) -> None:
    """Print one row per fifth: the mean over seeds, and the standard deviation over seeds in brackets."""
    if args.updates < 5 or args.seeds < 2:
        raise SystemExit("error: --updates must be at least 5, --seeds at least 2")
    total = args.transitions + args.transitions // 10
    env, memory, _ = play(args.game, total, total)
    results = {precision: np.array([learn(args, seed, precision, memory, int(env.action_space.n))
                                    for seed in range(args.seeds)])  # (seeds, 5, 2)
               for precision in (torch.float32, torch.bfloat16)}
    print(f"{args.game}, {args.seeds} seeds, held-out transitions\n")
    print(f"{'updates':>8}{'Huber loss, float32':>26}{'bfloat16':>24}{'max Q, float32':>24}{'bfloat16':>22}")
    silent = 0.5 * np.square(memory.rewards[args.transitions :]).mean()  # rewards of at most 1: the square part
    print(f"{'Q = 0':>8}{silent:>26.5f}{silent:>24.5f}{0:>24.5f}{0:>22.5f}")
    for k in range(5):
        cells = [f"{values[:, k, column].mean():.5f} ({values[:, k, column].std(ddof=1):.5f})"
                 for column in range(2) for values in results.values()]
        print(f"{args.updates // 5 * (k + 1):>8}{cells[0]:>26}{cells[1]:>24}{cells[2]:>24}{cells[3]:>22}")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
