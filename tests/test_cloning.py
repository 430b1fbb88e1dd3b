"""Behavior cloning: what GNN learns from, how it stops, and how it goes on."""

import numpy as np
import pytest
from gnn_teams import SCENE, SMALL, observation, played
from helpers import one_line, record_logs, same, small_search, weights
from stable_baselines3.common.logger import Logger, configure

from area_search import AreaSearchEnv
from sb3_roles import MAPPO
from sb3_roles.common.checkpoint import CheckpointError, CheckpointFolder
from sb3_roles.common.team_vec_env import make_team_vec_env
from sb3_roles.gnn import GNN, GNNPolicy
from sb3_roles.gnn.demonstrations import DemonstrationError
from sb3_roles.gnn.recording import record
from sb3_roles.mappo.policies import TeamActorCriticPolicy
from sb3_roles.zoo.stop_signals import StopSignals
from sb3_roles.zoo.training import train


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
    loaded = GNN.load(tmp_path / "model", trust=True)
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


def saved_state(demonstrations):
    """The state of a cloning after one epoch, as a checkpoint keeps it."""
    model = cloner(demonstrations)
    model.learn(epochs(model, 1))
    return model.get_state()


def first_weight(state, change):
    name = next(iter(state["best_weights"]))
    return {**state["best_weights"], name: change(state["best_weights"][name])}


ODD_STATES = {
    "no weights": (lambda s: {**s, "best_weights": {}}, "0 best weights"),
    "a missing weight": (
        lambda s: {**s, "best_weights": dict(list(s["best_weights"].items())[1:])},
        "is in one only",
    ),
    "another shape": (
        lambda s: {**s, "best_weights": first_weight(s, lambda w: w[:1])},
        "do not fit the policy",
    ),
    "another type": (
        lambda s: {**s, "best_weights": first_weight(s, lambda w: w.astype(np.float64))},
        "torch.float64",
    ),
    "text": (lambda s: {**s, "best_weights": first_weight(s, str)}, "damaged state"),
    "a missing key": (lambda s: {k: v for k, v in s.items() if k != "best_loss"}, "damaged state"),
    "a later best epoch": (lambda s: {**s, "best_epoch": 2}, "best epoch 2 of 1"),
}


@pytest.mark.parametrize("damage", ODD_STATES)
def test_a_state_that_does_not_fit_is_refused_at_once(demonstrations, damage):
    change, hint = ODD_STATES[damage]
    model = cloner(demonstrations)
    with pytest.raises(CheckpointError) as caught:
        model.set_state(change(saved_state(demonstrations)))
    assert hint in one_line(caught.value)
    assert model.epochs == 0
    assert model.best_weights == {}


def test_a_run_goes_on_with_its_own_demonstrations_only(demonstrations, tmp_path):
    state = saved_state(demonstrations)
    # More episodes in another file, of which the first are the same.
    longer = tmp_path / "longer.npz"
    record("greedy_assigned", SCENE, 21, seed=0, path=longer)
    model = cloner(longer)
    model.set_state(state)
    assert model.epochs == 1
    for name, change in (
        ("seed was 0, is 1", {"seed": 1}),
        ("controller was 'greedy_assigned', is 'random'", {"controller": "random"}),
    ):
        path = tmp_path / f"{len(name)}.npz"
        arguments = {"controller": "greedy_assigned", "seed": 0, **change}
        record(scene=SCENE, n_episodes=20, path=path, **arguments)
        other = cloner(path)
        with pytest.raises(CheckpointError) as caught:
            other.set_state(state)
        assert name in one_line(caught.value)
        assert other.epochs == 0
    with pytest.raises(CheckpointError, match="episodes was 20, is 15"):
        cloner(demonstrations, n_demonstrations=15).set_state(state)


def test_a_model_says_what_it_learns_from(demonstrations, tmp_path, capsys):
    model = cloner(demonstrations, verbose=1)
    model.data()
    line = capsys.readouterr().out.splitlines()[-1]
    assert line == model.summary()
    assert "20 episodes of greedy_assigned, 10 steps of 3 robots on 11 x 11 cells, seed 0" in line
    assert model.facts["sha256"][:16] in line
    assert "another scene" not in line
    # GNN reads any map and team: it says what they are.
    path = tmp_path / "other.npz"
    record("random", SCENE.with_options(height=9, n_agents=2), 4, seed=0, path=path)
    other = cloner(path, n_demonstrations=4)
    assert other.summary().endswith(
        "another scene than the run's: height 9, here 11; n_agents 2, here 3"
    )
    other.learn(epochs(other, 1))
    assert other.epochs == 1


def test_demonstrations_that_the_policy_can_not_read_are_refused(demonstrations):
    model = cloner(demonstrations)
    # A policy of what one robot sees, which is not recorded.
    env = model.env
    other = GNN(TeamActorCriticPolicy, env, str(demonstrations), n_demonstrations=20, seed=0)
    with pytest.raises(DemonstrationError) as caught:
        other.check_data()
    assert "can not read demonstrations of 3 robots on 11 x 11 cells" in one_line(caught.value)


def test_what_can_not_be_recorded_is_refused_before_it_is_begun(monkeypatch):
    cloner(None, controller="greedy").check_data()
    with pytest.raises(ValueError, match="controller"):
        cloner(None, controller="gredy").check_data()

    def missing(name):
        raise ImportError(f"no module {name}")

    monkeypatch.setattr("sb3_roles.baselines.ortools_routing.import_module", missing)
    with pytest.raises(ImportError) as caught:
        cloner(None, controller="vrpc").check_data()
    assert "sb3_roles[vrp]" in one_line(caught.value)


def test_a_recording_tells_how_far_it_is(capsys):
    counts = []
    cloner(None, controller="random", n_demonstrations=30).data(counts.append)
    assert counts == [25, 30]
    assert capsys.readouterr().out == ""
    cloner(None, controller="random", n_demonstrations=30, verbose=1).data()
    out = capsys.readouterr().out
    assert "recorded 25 of 30 episodes of random\nrecorded 30 of 30 episodes of random\n" in out
