"""Statistics: the Random policy's scores, the places of targets and robots, the random bits."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from helpers import boards, has

from area_search import BatchedAreaSearch
from area_search import cells as layout
from area_search.random_streams import draw, episode_key, normal_pair, seed_key, to_unit

N_EPISODES = 600
# (scene, robots): lowest and highest percentage of explo_paper, then of cover.
GATES = {
    ("hard", 4): ((21.5, 22.0), (11.2, 11.3)),
    ("obstacles_16", 4): ((18.8, 19.1), (9.8, 10.0)),
    ("obstacles_52", 4): ((25.7, 25.7), (12.9, 12.9)),
    ("hard", 8): ((27.6, 28.3), (15.6, 16.0)),
    ("hard", 15): ((33.9, 34.4), (20.5, 20.5)),
}


@pytest.mark.parametrize(("scene", "n_agents"), GATES)
def test_the_random_policy_scores_as_it_must(scene: str, n_agents: int) -> None:
    batch = BatchedAreaSearch(scene, N_EPISODES, n_agents=n_agents)
    batch.reset(0)
    rng = np.random.default_rng(0)
    for _ in range(batch.scene.horizon):
        batch.step(rng.integers(0, 5, (N_EPISODES, n_agents)))
    assert batch.truncated.all()
    for name, (low, high) in zip(("explo_paper", "cover"), GATES[scene, n_agents], strict=True):
        percent = 100 * batch.metrics[name]
        error = percent.std(ddof=1) / np.sqrt(N_EPISODES)
        assert low - 3 * error <= percent.mean() <= high + 3 * error, (name, percent.mean(), error)
        # The bound means something: the run is long enough to tell the scenes apart.
        assert error < 0.6


def chi_square_bound(degrees: int) -> float:
    """Return four standard deviations above the mean of a chi-square distribution."""
    return degrees + 4 * np.sqrt(2 * degrees)


@pytest.mark.parametrize("scene", ["easy", "hard", "super_hard", "obstacles_16", "obstacles_52"])
def test_targets_are_uniform_over_the_free_cells(scene: str) -> None:
    batch = BatchedAreaSearch(scene, 400)
    batch.reset(1)
    board = boards(batch)
    free, target = ~has(board, layout.OBSTACLE), has(board, layout.TARGET | layout.COVERED)
    n, k = batch.scene.n_free, batch.scene.n_targets
    assert (target & ~free).sum() == 0
    assert (target.sum(axis=(1, 2)) == k).all()
    # Without repeats the counts vary less than independent draws by this factor.
    spread = (n - k) / (n - 1)

    # By place in the map, in 15 parts with as many free cells each (but for rounding).
    in_order = np.stack([target[m][free[m]] for m in range(batch.n_teams)])
    parts = [part.sum() for part in np.array_split(in_order, 15, axis=1)]
    sizes = np.array([len(part) for part in np.array_split(np.arange(n), 15)]) * batch.n_teams
    expected = sizes * k / n
    assert np.sum((parts - expected) ** 2 / expected) / spread < chi_square_bound(14)

    # By the number of free neighbors: a walk that prefers the middle of rooms would show here.
    padded = np.pad(free, ((0, 0), (1, 1), (1, 1)))
    neighbors = sum(
        padded[:, 1 + dy : 26 + dy, 1 + dx : 26 + dx].astype(int)
        for dy, dx in ((-1, 0), (1, 0), (0, -1), (0, 1))
    )
    chi = 0.0
    for count in range(1, 5):
        where = free & (neighbors == count)
        expected_here = where.sum() * k / n
        assert expected_here > 50
        chi += (target[where].sum() - expected_here) ** 2 / expected_here
    assert chi / spread < chi_square_bound(3)


def test_carving_starts_anywhere_and_robots_start_near_each_other() -> None:
    batch = BatchedAreaSearch("hard", 2000)
    batch.reset(2)
    centers = batch.position.mean(axis=1)
    # No half of the map is preferred: maps are as often in one as in the other.
    free = ~has(boards(batch), layout.OBSTACLE)
    share = free.mean(axis=0)
    for half in (
        share[:12].mean() - share[13:].mean(),
        share[:, :12].mean() - share[:, 13:].mean(),
    ):
        assert abs(half) < 4 * 0.6 / np.sqrt(batch.n_teams)
    assert np.abs(centers.mean(axis=0) - 12).max() < 4 * 25 / np.sqrt(12 * batch.n_teams) + 0.5
    # Round-toward-zero of a normal number with sigma 1, redrawn on obstacles: spread near 1.
    spread = batch.position.std(axis=1, ddof=1).mean()
    assert 0.6 < spread < 1.6


N_DRAWS = 20_000


def words(seed: int, episode: int, n: int = N_DRAWS) -> np.ndarray:
    """Return the first numbers of a stream, uint64 (n,)."""
    key = seed_key(seed)
    # Numba hands plain integers to Python, and takes those for signed ones.
    second = np.uint64(episode_key(key, episode))
    return np.array([draw(key[0], second, np.uint64(i)) for i in range(n)], np.uint64)


def bits(numbers: np.ndarray) -> np.ndarray:
    """Return the bits of each number, uint8 (n, 64)."""
    return np.unpackbits(numbers.view(np.uint8).reshape(-1, 8), axis=1)


STREAMS = [(0, 0), (0, 1), (1, 0), (2**64, 0), (12345, 10**12)]


@pytest.mark.parametrize(("seed", "episode"), STREAMS)
def test_the_bits_of_a_stream_are_balanced_and_uncorrelated(seed: int, episode: int) -> None:
    numbers = words(seed, episode)
    assert len(np.unique(numbers)) == N_DRAWS
    sigma = 0.5 / np.sqrt(N_DRAWS)
    ones = bits(numbers)
    assert np.abs(ones.mean(axis=0) - 0.5).max() < 5 * sigma
    # A number and the next one, or the one after 32 (a batch of directions): no bit predicts it.
    for lag in (1, 2, 32):
        agree = (ones[lag:] == ones[:-lag]).mean(axis=0)
        assert np.abs(agree - 0.5).max() < 5 * sigma * 1.01


@pytest.mark.parametrize(("seed", "episode"), STREAMS)
def test_unit_numbers_are_uniform(seed: int, episode: int) -> None:
    unit = np.array([to_unit(word) for word in words(seed, episode)])
    assert unit.min() >= 0
    assert unit.max() < 1
    assert abs(unit.mean() - 0.5) < 4 / np.sqrt(12 * N_DRAWS)
    counts = np.histogram(unit, 50, (0, 1))[0]
    assert np.sum((counts - N_DRAWS / 50) ** 2) / (N_DRAWS / 50) < chi_square_bound(49)
    pairs = np.histogram2d(unit[::2], unit[1::2], 10, [(0, 1), (0, 1)])[0]
    assert np.sum((pairs - N_DRAWS / 200) ** 2) / (N_DRAWS / 200) < chi_square_bound(99)


def test_the_largest_word_is_below_one() -> None:
    assert to_unit(np.uint64(2**64 - 1)) < 1
    assert to_unit(np.uint64(0)) == 0


@pytest.mark.parametrize("other", [(0, 1), (1, 0), (1, 1), (0, 2**40)])
def test_neighboring_streams_are_unrelated(other: tuple[int, int]) -> None:
    here, there = words(0, 0), words(*other)
    assert len(np.intersect1d(here, there)) == 0
    differing = bits(here ^ there)
    sigma = 0.5 / np.sqrt(N_DRAWS)
    assert np.abs(differing.mean(axis=0) - 0.5).max() < 5 * sigma
    # Nor is one a shifted copy of the other.
    for shift in range(1, 5):
        assert not np.any(here[shift:] == there[:-shift])


def test_no_two_of_many_streams_are_equal() -> None:
    first = {
        words(seed, episode, 1)[0] for seed, episode in itertools.product(range(50), range(100))
    }
    assert len(first) == 50 * 100


def test_normal_numbers_have_mean_0_variance_1_and_do_not_depend_on_each_other() -> None:
    key = seed_key(5)
    second, counter, pairs = np.uint64(episode_key(key, 0)), np.uint64(0), []
    for _ in range(N_DRAWS):
        a, b, after = normal_pair(key[0], second, counter)
        assert after >= counter + np.uint64(2)
        counter = np.uint64(after)
        pairs.append((a, b))
    values = np.array(pairs)
    error = 1 / np.sqrt(N_DRAWS)
    assert np.abs(values.mean(axis=0)).max() < 4 * error
    assert np.abs(values.var(axis=0) - 1).max() < 4 * np.sqrt(2) * error
    assert abs(np.mean(values[:, 0] * values[:, 1])) < 4 * error
    # Kurtosis 3 tells a normal distribution from a uniform or a triangular one.
    assert abs(np.mean(values**4) - 3) < 4 * np.sqrt(96 / 2) * error


@pytest.mark.parametrize("seed", [-1, 1.0, "3", None, True])
def test_a_seed_is_a_whole_number_of_at_least_0(seed: object) -> None:
    with pytest.raises(ValueError, match="seed must be a whole number of at least 0"):
        seed_key(seed)  # type: ignore[arg-type]
