"""``sb3-roles bench train --compare``: both sides do the same work, whatever time it takes."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch as th

from sb3_roles.zoo import bench_stock
from sb3_roles.zoo.bench_case import TUNED, Work, configure, training_case
from sb3_roles.zoo.bench_compare import RIVALS, Comparison, check_same_work
from sb3_roles.zoo.bench_literal import LiteralUpdate
from sb3_roles.zoo.cli import main
from sb3_roles.zoo.options import UsageError

SMALL = {"n_steps": 12, "batch_size": 12, "n_epochs": 2}
# The tuned default; and everything that it is not, on maps that have another number of patches.
VARIANTS = {
    "default": {},
    "other": {
        "policy_kwargs": {
            "share_encoders": False,
            "primitive_input": "own",
            "see_role": True,
            "goal_key": None,
        },
        "wrapper_kwargs": {"role_every": 3},
        "env_kwargs": {"height": 27, "width": 28, "communication_radius": 2.0},
        "kl_coef": 0.1,
    },
    "no graph": {"policy_kwargs": {"graph": False}, "n_shards": 1, "max_grad_norm": None},
}


def make_case(variant: str = "default"):
    changes = {**SMALL, **VARIANTS[variant]}
    fp32 = {"precision": "fp32", **changes.get("policy_kwargs", {})}
    case = training_case(TUNED, configure(changes={**changes, "policy_kwargs": fp32}, n_envs=3))
    # As in the middle of a training: at its end the learning rate is 0.
    case.model._current_progress_remaining = 0.5
    case.model._update_learning_rate(case.model.policy.optimizer)
    return case


def first_gradients(optimizer: th.optim.Optimizer) -> list[th.Tensor]:
    """Return a list that gets the gradients of the next step."""
    found: list[th.Tensor] = []

    def note(*_):
        if not found:
            found.extend(p.grad.clone() for p in optimizer.param_groups[0]["params"])

    optimizer.register_step_pre_hook(note)
    return found


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_literal_update_is_the_fast_one(variant):
    case = make_case(variant)
    literal = LiteralUpdate(case.model)
    literal.load()
    assert literal.check() < 1e-5
    before = [weight.detach().clone() for weight in literal.policy.weights.values()]
    expected = first_gradients(literal.optimizer)
    th.manual_seed(3)
    _, literal_work = literal.update()
    gradients = first_gradients(case.model.policy.optimizer)
    th.manual_seed(3)
    _, work = case.repeat_update()
    # 36 joint steps in minibatches of 12, two epochs, four robots.
    assert work == literal_work == Work(36, 144, 288, 6)
    scale = max(float(gradient.abs().max()) for gradient in expected)
    for found, gradient in zip(gradients, expected, strict=True):
        th.testing.assert_close(found, gradient, atol=1e-5 * scale, rtol=1e-4)
    # Behind six steps of Adam, too.
    after = [weight.detach() for weight in case.model.policy.parameters()]
    moved = max(float((a - b).abs().max()) for a, b in zip(after, before, strict=True))
    # By more than a step of Adam's is long.
    assert moved > 2 * case.model.policy.optimizer.param_groups[0]["lr"]
    for weight, own in zip(after, literal.policy.weights.values(), strict=True):
        assert float((weight - own.detach()).abs().max()) < 0.05 * moved
    case.close()


def test_a_literal_update_of_other_weights_is_refused():
    case = make_case()
    literal = LiteralUpdate(case.model)
    literal.load()
    with th.no_grad():
        literal.policy.weights["encoders.shared_joint.embed.bias"] += 0.1
    with pytest.raises(UsageError, match="literal forward pass differs by"):
        literal.check()
    case.close()


def test_a_literal_update_needs_patches():
    changes = {**SMALL, "policy_kwargs": {"encoder": "convolutions"}}
    case = training_case(TUNED, configure(changes=changes, n_envs=2))
    with pytest.raises(UsageError, match="set encoder to patches"):
        LiteralUpdate(case.model)
    case.close()


def test_another_update_leaves_the_counters_alone():
    case = make_case()
    case.measure(1)
    before = (replace(case.work), dict(case.watch.seconds), case.describe())
    case.repeat_update()
    assert (case.work, case.watch.seconds, case.describe()) == before
    case.close()


@pytest.mark.parametrize("counter", ["robot_steps", "samples_times_epochs", "optimizer_steps"])
def test_unequal_work_is_refused(counter):
    tuned = Work(100, 400, 1600, 8)
    check_same_work("rival", tuned, Work(50, 200, 800, 4))
    other = replace(tuned, **{counter: getattr(tuned, counter) + 1})
    with pytest.raises(UsageError, match=rf"rival: the work is not the same: {counter}"):
        check_same_work("rival", tuned, other)


def test_a_rival_with_more_epochs_is_refused(capsys, monkeypatch):
    honest = bench_stock.stock_case
    monkeypatch.setattr(
        bench_stock,
        "stock_case",
        lambda name, config, backend: honest(name, {**config, "n_epochs": 5}, backend),
    )
    options = ["--n-envs", "2", "--iterations", "1", "--repeats", "1"]
    with pytest.raises(SystemExit) as stop:
        main(["bench", "train", "--compare", "stock-native", *options])
    captured = capsys.readouterr()
    assert stop.value.code == 2
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    config = configure(n_envs=2)
    steps, epochs = 2 * config["n_steps"], config["n_epochs"]
    assert f"samples_times_epochs is {4 * 5 * steps:,} in {steps} joint steps" in captured.err
    # By itself and before the rival.
    both = 2 * steps
    assert f"and {4 * epochs * both:,} in {both:,} of the tuned default" in captured.err


def test_stock_ppo_reads_the_state_with_its_critic_only():
    config = configure(changes=SMALL, n_envs=2)
    case = bench_stock.stock_case("stock-native", config, "native")
    policy = case.model.policy
    obs, _ = policy.obs_to_tensor(case.env.reset())
    other = {**obs, "state": 1 - obs["state"]}
    with th.no_grad():
        logits = [policy.get_distribution(one).distribution for one in (obs, other)]
        values = [policy.predict_values(one) for one in (obs, other)]
    for first, second in zip(*logits, strict=True):
        assert th.equal(first.logits, second.logits)
    assert not th.equal(*values)
    # Maps stand in its buffer for every robot: 12 steps, 8 robots.
    assert case.model.rollout_buffer.observations["state"].shape == (12 * 8, 5, 25, 25)
    case.close()


def test_the_comparison_is_reported(capsys):
    options = ["--n-envs", "2", "--iterations", "2", "--repeats", "2", "--json"]
    assert main(["bench", "train", "--compare", *options]) == 0
    report = json.loads(capsys.readouterr().out)
    (tuned,) = report["cases"]
    # Two iterations by itself, and before each of the stock rivals, in each of two rounds.
    assert tuned["work"]["joint_steps"] == 2 * (3 * 2) * 2 * configure()["n_steps"]
    found = {one["name"]: one for one in report["comparisons"]}
    assert list(found) == list(RIVALS)
    assert [one["measured"] for one in found.values()] == ["training", "training", "update"]
    assert [one["ratio"]["target"] for one in found.values()] == [10, 5, None]
    for one in found.values():
        ratio, work = one["ratio"], one["work"]
        assert 0 < ratio["min"] <= ratio["median"] <= ratio["max"]
        target = ratio["target"]
        assert ratio["met"] is (None if target is None else ratio["median"] >= target)
        per_step = work["samples_times_epochs"] / work["joint_steps"]
        assert per_step == tuned["work"]["samples_times_epochs"] / tuned["work"]["joint_steps"]
        assert one["parameters"] > 100_000
    assert found["literal"]["parameters"] == tuned["parameters"]
    assert found["literal"]["forward_difference"] < 1e-5
    assert report["machine"]["stable_baselines3"]
    assert report["machine"]["environment"]["OMP_WAIT_POLICY"]


def test_a_comparison_takes_only_what_is_named():
    config = configure(changes=SMALL, n_envs=2)
    case = training_case(TUNED, config)
    comparison = Comparison(case, config, ["literal"])
    case.measure(1)
    comparison.measure(1)
    assert [one["name"] for one in comparison.describe()] == ["literal"]
    comparison.close()
    case.close()
