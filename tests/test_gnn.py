"""The team's graph, the networks on it, and behavior cloning."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from helpers import (
    collect,
    hand_made,
    one_line,
    policy_space,
    record_logs,
    same,
    sharpen,
    small_search,
    weights,
)
from stable_baselines3.common.logger import Logger, configure

from area_search import AreaSearchEnv, BatchedAreaSearch, get_scene
from area_search.reference import ReferenceAreaSearch
from sb3_roles import MAPPO
from sb3_roles.common.checkpoint import CheckpointFolder
from sb3_roles.common.distributions import LOG_ZERO
from sb3_roles.common.team_vec_env import make_team_vec_env
from sb3_roles.gnn import GNN, GNNPolicy, H2GNNPolicy
from sb3_roles.gnn.graphs import build_graphs
from sb3_roles.gnn.message_passing import MessagePassing
from sb3_roles.gnn.recording import record
from sb3_roles.zoo.training import StopSignals, train

POLICIES = [GNNPolicy, H2GNNPolicy]
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


# The known map, which the graph is made of


def test_the_known_map_is_the_reference_s():
    batch = BatchedAreaSearch(SCENE, 2, known_map=True)
    batch.reset([3, 4], 0)
    references = [ReferenceAreaSearch(SCENE, seed, known_map=True) for seed in (3, 4)]
    rng = np.random.default_rng(0)
    for _ in range(10):
        for m, reference in enumerate(references):
            assert np.array_equal(batch.observations["known"][m], reference.observe()[0]["known"])
        moves = rng.integers(0, 5, (2, 3))
        batch.step(moves)
        for reference, row in zip(references, moves.tolist(), strict=True):
            reference.step(row)


def test_the_known_map_changes_no_other_observation():
    plain, more = (BatchedAreaSearch(SCENE, 2, known_map=k) for k in (False, True))
    plain.reset(0)
    more.reset(0)
    assert set(more.observations) - set(plain.observations) == {"known"}
    assert plain.team_observation_keys == ("joint", "state")
    for moves in np.random.default_rng(0).integers(0, 5, (10, 2, 3)):
        for key, value in plain.observations.items():
            assert np.array_equal(value, more.observations[key])
        plain.step(moves)
        more.step(moves)


@pytest.mark.parametrize("backend", ["native", "supersuit"])
def test_the_known_map_reaches_the_rows(backend):
    env = small_search(backend=backend, known_map=True)
    seen = env.reset()
    assert seen["known"].shape == (2, 2, 11, 11)
    assert seen["known"][:, 0].sum() > 0
    single = AreaSearchEnv(scene=SCENE, known_map=True)
    first, _ = single.reset(seed=0)
    copy = single.batched(1)
    copy.reset([0], 0)
    assert np.array_equal(first["robot_0"]["known"], copy.observations["known"][0])


# Graphs


def edges_of(graphs):
    return set(
        zip(
            graphs.senders.tolist(),
            graphs.receivers().tolist(),
            graphs.lengths.tolist(),
            strict=True,
        )
    )


def test_the_graph_of_a_hand_made_map():
    # Cells 0 1 2 / 3 in order; robots are nodes 4 and 5. The target is not frontier here.
    batch = hand_made(["0.T#", "#1#?", "####"])
    batch.show_known_map()
    graphs = graphs_of(batch)
    assert graphs.features.tolist() == [
        [0, 1, 0, 0],
        [0, 1, 0, 0],
        [0, 1, 1, 1],
        [0, 1, 0, 0],
        [1, 0, 0, 0],
        [1, 0, 0, 0],
    ]
    both = [(0, 1, 1), (1, 2, 1), (1, 3, 1), (4, 0, 0), (4, 1, 1), (5, 3, 0), (5, 1, 1)]
    assert edges_of(graphs) == {*both, *((v, u, length) for u, v, length in both)}
    assert graphs.teams.tolist() == [0, 6]
    # Stop, up, right, down, left.
    assert graphs.open.tolist() == [
        [True, False, True, False, False],
        [True, True, False, False, False],
    ]
    assert graphs.ends.tolist() == [[4, 0, 4, 1, 4, 4], [5, 3, 1, 5, 5, 5]]


def test_graphs_are_those_of_a_slow_reference():
    batch = played(4, n_agents=5)
    graphs = graphs_of(batch)
    edges, first = set(), 0
    for m in range(4):
        known = batch.observations["known"][m, 0]
        cells = [tuple(cell) for cell in np.argwhere(known).tolist()]
        node = {cell: first + k for k, cell in enumerate(cells)}
        for (y, x), v in node.items():
            near = [(y - 1, x), (y, x + 1), (y + 1, x), (y, x - 1)]
            edges |= {(node[cell], v, 1) for cell in near if cell in node}
        for i, (y, x) in enumerate(batch.position[m].tolist()):
            robot = first + len(cells) + i
            for length, cell in [(0, (y, x))] + [
                (1, near) for near in ((y - 1, x), (y, x + 1), (y + 1, x), (y, x - 1))
            ]:
                if cell in node:
                    edges |= {(node[cell], robot, length), (robot, node[cell], length)}
        first += len(cells) + 5
    assert edges_of(graphs) == edges
    assert len(graphs.senders) == len(edges)
    assert len(graphs.features) == first


def test_a_robot_off_the_map_is_refused():
    free = th.ones(1, 5, 5, dtype=th.uint8)
    with pytest.raises(ValueError, match="not on the map"):
        build_graphs(free, free, free, th.tensor([[[2.0, 5.0]]]))


# Message passing


def slow_hops(net, graphs):
    """The formula of the docstring, node by node and edge by edge."""
    nodes = list(net.encoder(graphs.features))
    edges = sorted(edges_of(graphs))
    read = [[nodes[v] for v in graphs.ends.flatten().tolist()]]
    for _ in range(net.n_hops):
        new = []
        for v in range(len(nodes)):
            messages = [
                th.relu(
                    net.as_sender(nodes[u])
                    + net.as_receiver(nodes[v])
                    + net.by_length(th.tensor([float(length)]))
                )
                for u, to, length in edges
                if to == v
            ]
            mean = sum(messages) / len(messages) if messages else th.zeros(net.width)
            new.append(th.relu(net.own(nodes[v]) + net.message(mean)))
        nodes = new
        read.append([nodes[v] for v in graphs.ends.flatten().tolist()])
    shape = (-1, *graphs.ends.shape, net.width)
    return th.stack([th.stack(one) for one in read]).view(shape).permute(1, 2, 0, 3)


def gradients(net, embeddings):
    net.zero_grad(set_to_none=True)
    scale = th.linspace(-1, 1, embeddings.numel()).view(embeddings.shape)
    (embeddings * scale).sum().backward()
    return {name: p.grad for name, p in net.named_parameters()}


def test_hops_and_their_gradients_are_those_of_a_slow_reference():
    th.manual_seed(0)
    net = MessagePassing(width=6, n_hops=3)
    graphs = graphs_of(played(2, n_agents=2, height=7, width=7, n_targets=5))
    slow = slow_hops(net, graphs)
    expected = gradients(net, slow)
    for compiled in (False, True):
        fast = net(graphs, compiled)
        th.testing.assert_close(fast, slow)
        for name, gradient in gradients(net, fast).items():
            th.testing.assert_close(gradient, expected[name], atol=1e-4, rtol=1e-4, msg=name)
            assert gradient.abs().max() > 0, name


@pytest.mark.parametrize("n_teams", [1, 33, 70])
def test_the_compiled_loop_is_the_list_of_edges(n_teams):
    # More teams than are computed together.
    th.manual_seed(1)
    net = MessagePassing(width=16, n_hops=5)
    graphs = graphs_of(played(n_teams))
    plain, compiled = net(graphs, False), net(graphs, True)
    th.testing.assert_close(plain, compiled)
    expected = gradients(net, plain)
    for name, gradient in gradients(net, compiled).items():
        scale = expected[name].abs().max()
        assert (gradient - expected[name]).abs().max() < 1e-3 * scale, name


def test_pytorch_geometric_agrees():
    geometric = pytest.importorskip("torch_geometric.nn")

    class Core(geometric.MessagePassing):
        def __init__(self, net):
            super().__init__(aggr="mean")
            self.net = net

        def forward(self, nodes, edges, lengths):
            means = self.propagate(edges, x=nodes, lengths=lengths, size=(len(nodes), len(nodes)))
            return th.relu(self.net.own(nodes) + self.net.message(means))

        def message(self, x_i, x_j, lengths):
            net = self.net
            return th.relu(net.as_sender(x_j) + net.as_receiver(x_i) + net.by_length(lengths))

    net = MessagePassing(width=8, n_hops=4)
    graphs = graphs_of(played(3))
    core, edges = Core(net), th.stack([graphs.senders, graphs.receivers()])
    nodes = net.encoder(graphs.features)
    for _ in range(net.n_hops):
        nodes = core(nodes, edges, graphs.lengths.float().unsqueeze(1))
    th.testing.assert_close(net(graphs)[:, :, -1], nodes[graphs.ends])


def test_nodes_without_edges_and_nan_are_handled():
    nothing = th.zeros(2, 5, 5, dtype=th.uint8)
    graphs = build_graphs(nothing, nothing, nothing, th.zeros(2, 3, 2))
    assert len(graphs.senders) == 0
    net = MessagePassing(width=4, n_hops=2)
    th.testing.assert_close(net(graphs, True), net(graphs, False))
    with th.no_grad():
        net.as_sender.weight.fill_(float("nan"))
    assert net(graphs_of(played(1)), True)[:, :, -1].isnan().all()


# Policies


@pytest.mark.parametrize("policy_class", POLICIES)
def test_robots_may_be_numbered_in_any_way(policy_class):
    policy = make_policy(policy_class)
    obs = observation(played(4, n_agents=5))
    order = th.tensor([3, 0, 4, 2, 1])
    rows = (order + 5 * th.arange(4).unsqueeze(1)).flatten()
    permuted = {**obs, "position": obs["position"][rows]}
    first = log_probs(policy, obs)
    th.testing.assert_close(log_probs(policy, permuted), first[rows], atol=1e-5, rtol=1e-4)
    assert (first[0] - first[1]).abs().max() > 1e-3


@pytest.mark.parametrize("policy_class", POLICIES)
def test_a_team_is_answered_the_same_in_any_batch(policy_class):
    policy = make_policy(policy_class)
    obs = observation(played(40))
    together = log_probs(policy, obs)
    for m in (0, 17, 39):
        alone = {
            key: value[3 * m : 3 * m + 3] if len(value) == 120 else value[m : m + 1]
            for key, value in obs.items()
        }
        th.testing.assert_close(
            log_probs(policy, alone), together[3 * m : 3 * m + 3], atol=1e-5, rtol=1e-4
        )


@pytest.mark.parametrize("policy_class", POLICIES)
def test_maps_may_be_given_for_each_robot(policy_class):
    policy = make_policy(policy_class)
    obs = observation(played(3))
    repeated = {
        key: value.repeat_interleave(3, dim=0) if key in ("joint", "known", "state") else value
        for key, value in obs.items()
    }
    assert th.equal(log_probs(policy, repeated), log_probs(policy, obs))


@pytest.mark.parametrize("policy_class", POLICIES)
@pytest.mark.parametrize(("n_agents", "size"), [(1, 11), (2, 7), (8, 17), (50, 25)])
def test_the_same_weights_serve_any_team_and_map(policy_class, n_agents, size):
    policy = make_policy(policy_class)
    obs = observation(played(2, n_agents=n_agents, height=size, width=size + 2))
    said = log_probs(policy, obs)
    assert said.shape == (2 * n_agents, 5)
    th.testing.assert_close(said.exp().sum(1), th.ones(2 * n_agents))
    actions, values, log_prob = policy(obs)
    assert len(actions) == len(values) == len(log_prob) == 2 * n_agents


@pytest.mark.parametrize("policy_class", POLICIES)
@pytest.mark.parametrize("seed", range(4))
def test_fresh_embeddings_neither_explode_nor_vanish(policy_class, seed):
    policy = make_policy(policy_class, seed=seed, n_hops=16, hop_width=16)
    sizes = policy.message_passing(graphs_of(played(5))).square().mean((0, 1, 3)).sqrt()
    # Without the scaling they grow up to ten thousandfold.
    assert sizes.max() < 10 * sizes[0]
    assert sizes.min() > sizes[0] / 10


@pytest.mark.parametrize("policy_class", POLICIES)
def test_only_moves_with_an_edge_are_possible(policy_class):
    batch = hand_made(["0.T#", "#1#?", "####"])
    batch.show_known_map()
    policy = make_policy(policy_class)
    said = log_probs(policy, observation(batch))
    possible = [[True, False, True, False, False], [True, True, False, False, False]]
    assert (said.exp() > 0).tolist() == possible
    assert (said[~th.tensor(possible)] < LOG_ZERO / 2).all()
    th.manual_seed(0)
    drawn = th.stack([policy(observation(batch))[0] for _ in range(50)])
    assert set(drawn[:, 0].tolist()) == {0, 2}
    assert set(drawn[:, 1].tolist()) == {0, 1}


def test_a_robot_sees_as_far_as_its_hops():
    # A corridor: the target is 9 cells away; its neighbor's news travel one cell a hop.
    near, far = (hand_made([f"0........{last}"]) for last in (".", "T"))
    for n_hops, differs in ((7, False), (8, True), (12, True)):
        policy = make_policy(n_hops=n_hops)
        said = []
        for batch in (near, far):
            batch.show_known_map()
            # No frontier: only the target tells the maps apart.
            said.append(log_probs(policy, {**observation(batch), "joint": joint_of(batch)}))
        assert (not th.equal(*said)) is differs, n_hops


def joint_of(batch):
    joint = th.from_numpy(batch.observations["joint"].copy())
    joint[:, 0] = 0
    return joint


def test_hops_are_weighted_by_heads_of_their_own():
    policy = make_policy(H2GNNPolicy)
    hops = th.randn(7, 5, 8)
    out = policy.attend(hops)
    heads = []
    for h in range(4):
        # By hand: per head 2 columns of the query, and of keys and values side by side.
        query = policy.query(hops[:, 0])[:, 2 * h : 2 * h + 2]
        key_value = policy.answer(hops)[:, :, 4 * h : 4 * h + 4]
        keys, values = key_value[..., :2], key_value[..., 2:]
        scores = (keys * query.unsqueeze(1)).sum(-1) / 2**0.5
        heads.append((scores.softmax(1).unsqueeze(-1) * values).sum(1))
    th.testing.assert_close(out, policy.attended(th.cat(heads, dim=1)))
    # The order of the hops carries nothing but the first, which asks.
    shuffled = hops[:, [0, 3, 1, 4, 2]]
    th.testing.assert_close(policy.attend(shuffled), out)


@pytest.mark.parametrize("policy_class", POLICIES)
def test_actors_do_not_read_the_state_and_share_nothing_with_critics(policy_class):
    policy = make_policy(policy_class)
    obs = observation(played(2))
    changed = {**obs, "state": 1 - obs["state"]}
    assert th.equal(log_probs(policy, obs), log_probs(policy, changed))
    del changed["state"]
    assert th.equal(log_probs(policy, obs), log_probs(policy, changed))
    policy.get_distribution(obs).distribution.logits[:, 0].sum().backward()
    actor = {name for name, p in policy.named_parameters() if p.grad is not None}
    critic = {name for name, _ in policy.named_parameters() if "value" in name}
    assert actor.isdisjoint(critic)
    assert actor | critic == {name for name, _ in policy.named_parameters()}


BAD = [
    ({"n_hops": 0}, "n_hops must be a whole number"),
    ({"hop_width": 6.0}, "hop_width must be a whole number"),
    ({"precision": "fp23"}, "did you mean 'fp32'"),
    ({"use_sde": True}, "discrete"),
    ({"critic_keys": ["stat"]}, "did you mean 'state'"),
]


@pytest.mark.parametrize(("options", "hint"), BAD)
def test_bad_options_give_one_line(options, hint):
    with pytest.raises(ValueError) as caught:
        make_policy(**options)
    assert hint in one_line(caught.value)


def test_heads_must_divide_the_embedding():
    with pytest.raises(ValueError, match="n_heads must divide hop_width, 8, got 3"):
        make_policy(H2GNNPolicy, n_heads=3)


def test_an_environment_without_the_known_map_is_refused():
    with pytest.raises(ValueError) as caught:
        MAPPO(H2GNNPolicy, small_search(), policy_kwargs=SMALL)
    assert "known_map: true" in one_line(caught.value)


# H2GNN is MAPPO with its policy


def h2gnn(**options):
    env = small_search(known_map=True)
    return MAPPO(
        H2GNNPolicy,
        env,
        n_steps=10,
        batch_size=8,
        n_epochs=2,
        seed=0,
        policy_kwargs=SMALL,
        **options,
    )


def test_learning_rate_0_leaves_the_ratio_at_1():
    model = h2gnn(learning_rate=0.0)
    logs = record_logs(model)
    collect(model)
    before = weights(model)
    model.train()
    model.logger.dump()
    assert logs[-1]["train/clip_fraction"] == 0
    assert abs(logs[-1]["train/kl"]) < 1e-6
    assert same(weights(model), before)


def test_mappo_trains_all_weights_and_repeats_itself():
    runs = []
    for _ in range(2):
        model = h2gnn(learning_rate=1e-2)
        before = weights(model)
        collect(model)
        model.train()
        runs.append(weights(model))
    assert same(*runs)
    assert not [name for name in before if th.equal(before[name], runs[0][name])]


# Cloning


def cloner(path, n_envs=2, patience=15, seed=0, **options):
    def make():
        return AreaSearchEnv(scene=SCENE, known_map=True)

    env = make_team_vec_env(make, n_envs, 0, expand_team_observations=False)
    arguments = {
        "demonstrations": None if path is None else str(path),
        "n_demonstrations": 20,
        "n_steps": 1,
        "policy_kwargs": {**SMALL, "n_hops": 8},
    }
    return GNN("GNNPolicy", env, patience=patience, seed=seed, **{**arguments, **options})


def epochs(model, n):
    """Robot steps, as ``learn`` counts, that are n epochs."""
    return n * model.n_steps * model.env.num_envs


@pytest.fixture(scope="module")
def demonstrations(tmp_path_factory):
    path = tmp_path_factory.mktemp("demonstrations") / "greedy.npz"
    record("greedy_assigned", SCENE, 20, seed=0, path=path)
    return path


def test_cloning_learns_what_was_demonstrated(demonstrations):
    model = cloner(demonstrations, learning_rate=5e-3, batch_size=8)
    logs = record_logs(model)
    model.learn(epochs(model, 20), log_interval=1)
    train, validation = model.data()
    loss, accuracy = model.validate(validation)
    # Five moves, of which some two do equally well at a time.
    uniform = np.log(5)
    assert loss < 0.55 * uniform
    assert accuracy > 0.7
    assert model.validate(train)[1] > 0.75
    losses = [log["train/loss"] for log in logs if "train/loss" in log]
    assert losses[-1] < 0.6 * losses[0]


def test_episodes_are_split_once_and_apart(demonstrations):
    train, validation = cloner(demonstrations).data()
    assert len(train) == 14 * 10
    assert len(validation) == 6 * 10
    assert sorted([*train.rows, *validation.rows]) == list(range(20))
    again, other = cloner(demonstrations).data(), cloner(demonstrations, seed=1).data()
    assert np.array_equal(again[0].rows, train.rows)
    assert not np.array_equal(np.sort(other[1].rows), np.sort(validation.rows))


def test_cloning_repeats_itself_and_follows_its_seed(demonstrations):
    models = [cloner(demonstrations, seed=seed) for seed in (0, 0, 1)]
    for model in models:
        model.learn(epochs(model, 2))
    assert same(weights(models[0]), weights(models[1]))
    assert not same(weights(models[0]), weights(models[2]))


def test_the_learning_rate_decays_with_the_updates(demonstrations):
    model = cloner(demonstrations, batch_size=10, lr_decay=0.5, lr_decay_every=5)
    logs = record_logs(model)
    model.learn(epochs(model, 3), log_interval=1)
    model.logger.dump()
    # 14 updates per epoch: the last ones are numbers 13, 27 and 41.
    rates = [log["train/learning_rate"] for log in logs if "train/learning_rate" in log]
    assert rates == pytest.approx([1e-3 * 0.5**k for k in (2, 5, 8)])


def test_early_stopping_keeps_the_best_weights(demonstrations):
    model = cloner(demonstrations, patience=2)
    kept, losses = [], iter([0.9, 0.5, 0.6, 0.5, 0.4, 0.3])

    def validate(steps):
        kept.append(weights(model))
        return next(losses), 0.0

    model.validate = validate
    model.learn(epochs(model, 6))
    # The fourth is no better than the second: two epochs without progress.
    assert model.finished
    assert model.epochs == 4
    assert model.best_epoch == 2
    assert same(weights(model), kept[1])
    assert not same(kept[1], kept[3])
    assert not model.collect_rollouts(model.env, None, model.rollout_buffer, 1)


def test_the_end_of_the_run_has_the_best_weights_too(demonstrations):
    model = cloner(demonstrations, patience=None)
    kept, losses = [], iter([0.9, 0.2, 0.6])

    def validate(steps):
        kept.append(weights(model))
        return next(losses), 0.0

    model.validate = validate
    model.learn(epochs(model, 3))
    assert model.epochs == 3
    assert not model.finished
    assert same(weights(model), kept[1])


def run(model, folder, n_epochs, **options):
    checkpoints = CheckpointFolder(folder)
    checkpoints.prepare()
    model.set_logger(Logger(None, []))
    # Joint steps: two teams.
    steps = n_epochs * model.n_steps * 2
    train(model, steps, checkpoints, StopSignals(), stateful=[model], **options)
    return checkpoints


@pytest.mark.parametrize("cut", [1, 2, 3])
def test_a_stopped_cloning_goes_on_as_if_it_had_not(demonstrations, tmp_path, cut):
    options = {"patience": None, "learning_rate": 3e-2, "batch_size": 20}
    straight, begun, resumed = (cloner(demonstrations, **options) for _ in range(3))
    run(straight, tmp_path / "straight", 4)
    checkpoints = run(begun, tmp_path / "run", 4, stop_at=cut * begun.n_steps * 2)
    assert begun.epochs == cut
    run(resumed, tmp_path / "run", 4, resume=checkpoints.newest()[1])
    assert resumed.epochs == 4
    assert resumed.best_epoch == straight.best_epoch
    assert resumed.best_loss == straight.best_loss
    assert same(weights(resumed), weights(straight))


def test_demonstrations_are_recorded_when_there_is_no_file(tmp_path):
    model = cloner(None, controller="greedy_assigned", n_demonstrations=4)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(epochs(model, 1))
    assert len(model.data()[0].demonstrations) == 4
    assert (tmp_path / "demonstrations.npz").exists()
    facts = model.data()[0].demonstrations.facts
    assert facts["controller"] == "greedy_assigned"
    assert facts["scene"]["n_targets"] == 12


def test_a_demonstrated_move_without_an_edge_is_refused(demonstrations):
    model = cloner(demonstrations)
    train, _ = model.data()
    observations, actions = train.__getitems__(range(20))
    closed = ~model.policy.team_graphs(observations).open
    row = int(closed.any(1).nonzero()[0])
    actions[row] = int(closed[row].nonzero()[0])
    with pytest.raises(ValueError, match="into an obstacle or an unknown cell"):
        model._cross_entropy(observations, actions)


@pytest.mark.parametrize(
    ("options", "hint"),
    [
        ({"validation_share": 1.5}, "validation_share"),
        ({"lr_decay": -1}, "lr_decay"),
        ({"lr_decay_every": 0}, "lr_decay_every"),
        ({"patience": 0}, "patience"),
        ({"n_demonstrations": 0}, "n_demonstrations"),
        ({"batch_size": 0}, "batch_size"),
    ],
)
def test_bad_arguments_give_one_line(options, hint):
    with pytest.raises(ValueError) as caught:
        cloner(None, **options)
    assert one_line(caught.value).startswith(hint)


@pytest.mark.parametrize(
    ("options", "hint"),
    [
        ({"n_demonstrations": 21}, "there are 20 demonstrated episodes, 21 are asked for"),
        ({"validation_share": 0.0}, "leaves none to validate on"),
        ({"n_demonstrations": 1}, "leaves none"),
    ],
)
def test_demonstrations_that_do_not_suffice_give_one_line(demonstrations, options, hint):
    with pytest.raises(ValueError) as caught:
        cloner(demonstrations, **options).data()
    assert hint in one_line(caught.value)


def test_sb3_s_zip_restores_a_cloned_policy(demonstrations, tmp_path):
    model = cloner(demonstrations)
    model.learn(epochs(model, 1))
    model.save(tmp_path / "model")
    loaded = GNN.load(tmp_path / "model")
    assert same(weights(loaded), weights(model))
    obs = {key: value.numpy() for key, value in observation(played(2)).items()}
    first = model.predict(obs, deterministic=True)[0]
    assert np.array_equal(loaded.predict(obs, deterministic=True)[0], first)


def test_mappo_goes_on_from_a_cloned_actor(demonstrations):
    model = cloner(demonstrations)
    model.learn(epochs(model, 1))
    tuned = MAPPO(
        GNNPolicy,
        small_search(known_map=True),
        n_steps=5,
        batch_size=5,
        policy_kwargs={**SMALL, "n_hops": 8},
    )
    tuned.policy.load_state_dict(model.policy.state_dict())
    before = weights(tuned)
    tuned.learn(5 * tuned.env.num_envs)
    assert not same(weights(tuned), before)
