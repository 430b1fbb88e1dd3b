"""Training on a GPU: everything of a rollout is there, and says what a CPU says."""

from __future__ import annotations

import pytest
import torch as th
from helpers import small_search

from sb3_roles import HMAPPO, MAPPO

pytestmark = pytest.mark.skipif(not th.cuda.is_available(), reason="torch finds no GPU")
ALGORITHMS = [(MAPPO, "TeamPolicy"), (HMAPPO, "RolePolicy")]


def make(algorithm, policy, device, **options):
    kwargs = {"optimizer_class": th.optim.SGD, **options.pop("policy_kwargs", {})}
    return algorithm(
        policy, small_search(), n_steps=4, batch_size=6, n_epochs=1, seed=3, device=device,
        policy_kwargs=kwargs, **options,
    )  # fmt: skip


@pytest.mark.parametrize(("algorithm", "policy"), ALGORITHMS)
@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_a_run_stays_on_the_gpu(algorithm, policy, precision):
    model = make(
        algorithm, policy, "cuda", rollout_groups=2, n_shards=2, kl_coef=0.2,
        policy_kwargs={"precision": precision},
    )  # fmt: skip
    before = [value.clone() for value in model.policy.parameters()]
    model.learn(3 * 4 * model.n_envs)
    batch = next(iter(model.rollout_buffer.minibatches(6)))
    tensors = [*batch.observations.values(), batch.actions, *batch.old_log_probs, batch.returns]
    assert all(tensor.is_cuda for tensor in tensors)
    after = list(model.policy.parameters())
    assert all(value.is_cuda and th.isfinite(value).all() for value in after)
    assert any(not th.equal(one, other) for one, other in zip(before, after, strict=True))


@pytest.mark.parametrize(("algorithm", "policy"), ALGORITHMS)
def test_a_gpu_says_what_a_cpu_says(algorithm, policy):
    on_cpu, on_gpu = (make(algorithm, policy, device) for device in ("cpu", "cuda"))
    on_gpu.policy.load_state_dict(on_cpu.policy.state_dict())
    seen = on_cpu.env.reset()
    said = []
    for model in (on_cpu, on_gpu):
        obs = {key: th.as_tensor(value).to(model.device) for key, value in seen.items()}
        actions = th.zeros(model.n_envs, len(model.policy.stream_names), dtype=th.int64)
        said.append(model.policy.streams(obs, actions.to(model.device)))
    # Products in TensorFloat-32 have ten bits.
    for one, other in zip(said[0].log_probs, said[1].log_probs, strict=True):
        th.testing.assert_close(one, other.cpu(), atol=1e-2, rtol=1e-2)
    th.testing.assert_close(said[0].values, said[1].values.cpu(), atol=1e-2, rtol=1e-2)
