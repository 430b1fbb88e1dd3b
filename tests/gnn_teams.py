"""Teams, observations and policies for the tests of graphs and of cloning."""

import numpy as np
import torch as th
from gymnasium import spaces
from helpers import policy_space, sharpen

from area_search import BatchedAreaSearch, get_scene
from sb3_roles.gnn import GNNPolicy
from sb3_roles.gnn.graphs import build_graphs

SMALL = {"n_hops": 4, "hop_width": 8, "encoder": "patches", "value_arch": (16,)}
SCENE = get_scene("hard", height=11, width=11, n_targets=12, horizon=10, n_agents=3)


def played(n_teams, steps=6, seed=0, **options):
    """Teams after some steps of a random walk."""
    scene = SCENE.with_options(**options)
    batch = BatchedAreaSearch(scene, n_teams, known_map=True)
    batch.reset([seed + m for m in range(n_teams)], 0)
    rng = np.random.default_rng(seed)
    for _ in range(steps):
        batch.step(rng.integers(0, 5, (n_teams, batch.n_agents)))
    return batch


def observation(batch):
    """What a policy is given, maps once per team."""
    n, teams = batch.n_agents, batch.n_teams
    members = np.stack([np.arange(n), np.full(n, n)], axis=1).astype(np.float32)
    arrays = {key: batch.observations[key] for key in ("joint", "known", "state")}
    arrays["local"] = batch.observations["local"].reshape(teams * n, *(4, 9, 9))
    arrays["position"] = batch.observations["position"].reshape(-1, 2)
    arrays["agent"] = np.tile(members, (teams, 1))
    return {key: th.from_numpy(np.array(value)) for key, value in arrays.items()}


def graphs_of(batch):
    seen = {key: th.from_numpy(value) for key, value in batch.observations.items()}
    known, joint = seen["known"], seen["joint"]
    return build_graphs(known[:, 0], joint[:, 1], joint[:, 0], seen["position"])


def make_policy(policy_class=GNNPolicy, size=11, seed=0, **options):
    th.manual_seed(seed)
    boxes = {
        k: policy_space(size, size)[k] for k in ("local", "joint", "position", "state", "agent")
    }
    boxes["known"] = spaces.Box(0, 1, (2, size, size), np.uint8)
    space = spaces.Dict(boxes)
    policy = policy_class(space, spaces.Discrete(5), lambda _: 1e-3, **{**SMALL, **options})
    return sharpen(policy)


def log_probs(policy, obs):
    with th.no_grad():
        return policy.get_distribution(obs).distribution.logits
