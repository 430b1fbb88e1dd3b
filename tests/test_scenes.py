"""Scenes: the paper's numbers, and an error of one line for everything that cannot exist."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from helpers import one_line

from area_search import SCENES, AreaSearchEnv, BatchedAreaSearch, Scene, SceneError, get_scene
from area_search.scenes import MAX_AGENTS, MAX_HORIZON, MAX_SENSOR_RADIUS, MAX_SIZE, MAX_VIEW_RADIUS

TARGET_SHARES = {"easy": 0.56, "medium": 0.24, "hard": 0.16, "super_hard": 0.08}
FREE_FRACTIONS = {"obstacles_16": 0.84, "obstacles_40": 0.6, "obstacles_52": 0.49}
NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("name", "n_targets"), [("easy", 350), ("medium", 150), ("hard", 100), ("super_hard", 50)]
)
def test_difficulties_of_tables_1_to_3(name: str, n_targets: int) -> None:
    scene = get_scene(name)
    assert (scene.height, scene.width, scene.n_cells) == (25, 25, 625)
    assert (scene.n_free, scene.n_obstacles) == (375, 250)
    assert scene.n_targets == n_targets == round(TARGET_SHARES[name] * scene.n_cells)


@pytest.mark.parametrize(("name", "share"), FREE_FRACTIONS.items())
def test_obstacles_of_table_4(name: str, share: float) -> None:
    scene = get_scene(name)
    assert scene.free_fraction == share
    assert scene.n_targets == 100
    # Carving goes on until the share is reached, and not further.
    assert (scene.n_free - 1) / scene.n_cells < share <= scene.n_free / scene.n_cells


@pytest.mark.parametrize("name", SCENES)
def test_facts_that_all_scenes_share(name: str) -> None:
    scene = SCENES[name]
    assert scene.name == name
    assert scene.n_free + scene.n_obstacles == scene.n_cells
    assert (scene.n_agents, scene.horizon, scene.early_stop_patience) == (4, 50, None)
    assert (scene.sensor_radius, scene.view_radius, scene.communication_radius) == (2, 4, 10)
    assert (scene.spawn_sigma, scene.explore_normalizer) == (1, 3)
    assert (scene.alpha, scene.beta, scene.reward_sharing) == (0.4, 0.6, "own")


def test_the_registry_has_the_scenes_of_the_paper_and_no_others() -> None:
    assert set(SCENES) == set(TARGET_SHARES) | set(FREE_FRACTIONS)


@pytest.mark.parametrize("field", [field.name for field in dataclasses.fields(Scene)])
def test_a_scene_is_frozen_and_hashable(field: str) -> None:
    scene = get_scene("hard")
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(scene, field, getattr(scene, field))
    assert {scene: 1}[get_scene("hard")] == 1


def test_options_make_a_new_scene_and_leave_the_registered_one() -> None:
    before = get_scene("hard")
    changed = get_scene("hard", n_agents=8, early_stop_patience=10)
    assert (changed.n_agents, changed.early_stop_patience) == (8, 10)
    assert dataclasses.replace(changed, n_agents=4, early_stop_patience=None) == before
    assert changed.with_options(early_stop_patience=None).early_stop_patience is None
    assert get_scene("hard") == before
    assert get_scene(changed) is changed


INTEGER_RANGES = {
    "height": (5, MAX_SIZE),
    "width": (5, MAX_SIZE),
    "n_agents": (1, MAX_AGENTS),
    "view_radius": (1, MAX_VIEW_RADIUS),
    "horizon": (1, MAX_HORIZON),
    "early_stop_patience": (1, MAX_HORIZON),
}
NUMBER_RANGES = {
    "spawn_sigma": (0, 1e6),
    "spawn_sigma_growth": (1e-6, 1e6),
    "sensor_radius": (0, MAX_SENSOR_RADIUS),
    "communication_radius": (0, 1e6),
    "alpha": (0, 1e6),
    "beta": (0, 1e6),
}
BAD_INTEGERS = [
    (field, value, (f"{low}", f"{high}"))
    for field, (low, high) in INTEGER_RANGES.items()
    for value in (low - 1, high + 1, -1, True, False, 7.0, "7", [7], NAN, 10**400)
]
BAD_NUMBERS = [
    (field, value, (f"[{low:g}", f"{high:g}]"))
    for field, (low, high) in NUMBER_RANGES.items()
    for value in (-1, -1e-9, high * 1.001, NAN, INF, -INF, True, "1", None, 1j, 10**400)
]
BAD_FRACTIONS = [
    ("free_fraction", value, ("(0", "1]")) for value in (0, 0.0, 1.2, -0.1, NAN, "0.6", True, None)
]
BAD_NORMALIZERS = [
    ("explore_normalizer", value, ("(0", "1e+06]")) for value in (0, -3, NAN, INF, "3", False)
]
BAD_TARGETS = [
    ("n_targets", 0, ("1",)),
    ("n_targets", -5, ("1",)),
    ("n_targets", 376, ("1", "375 free cells", "0.6 of 25 x 25")),
    ("n_targets", 10**9, ("1", str(MAX_SIZE * MAX_SIZE))),
    ("n_targets", True, ("whole number",)),
    ("n_targets", 100.0, ("whole number",)),
    ("n_targets", None, ("whole number",)),
]
BAD_TEXTS = [
    ("reward_sharing", "same_roles", ("own, same_role", "did you mean 'same_role'")),
    ("reward_sharing", "Own", ("own, same_role", "did you mean 'own'")),
    ("reward_sharing", None, ("own, same_role",)),
    ("reward_sharing", ["own"], ("own, same_role",)),
    ("name", "", ("letters, digits",)),
    ("name", 3, ("letters, digits",)),
]
BAD_FIELDS = [
    *BAD_INTEGERS,
    *BAD_NUMBERS,
    *BAD_FRACTIONS,
    *BAD_NORMALIZERS,
    *BAD_TARGETS,
    *BAD_TEXTS,
]


@pytest.mark.parametrize(("field", "value", "parts"), BAD_FIELDS)
def test_a_bad_value_names_the_field_and_what_is_allowed(
    field: str, value: object, parts: tuple[str, ...]
) -> None:
    with pytest.raises(SceneError) as raised:
        get_scene("hard", **{field: value})
    message = one_line(raised.value)
    assert field in message
    for part in parts:
        assert part in message, message


@pytest.mark.parametrize("field", ["n_agents", "n_targets", "alpha", "name", "reward_sharing"])
def test_an_array_as_a_value_is_an_error_of_one_line(field: str) -> None:
    with pytest.raises(SceneError) as raised:
        get_scene("hard", **{field: np.zeros((3, 3))})
    assert field in one_line(raised.value)


@pytest.mark.parametrize(
    ("name", "hint"),
    [("hrd", "hard"), ("superhard", "super_hard"), ("obstacle_52", "obstacles_52")],
)
@pytest.mark.parametrize("make", [get_scene, BatchedAreaSearch, AreaSearchEnv])
def test_an_unknown_scene_gives_the_closest_match(make: type, name: str, hint: str) -> None:
    with pytest.raises(SceneError) as raised:
        make(name)
    message = one_line(raised.value)
    assert f"did you mean {hint!r}" in message
    assert repr(name) in message
    assert all(known in message for known in SCENES)


@pytest.mark.parametrize("scene", [None, 3, {"name": "hard"}, ["hard"], Scene])
def test_what_is_neither_a_name_nor_a_scene(scene: object) -> None:
    with pytest.raises(SceneError) as raised:
        get_scene(scene)  # type: ignore[arg-type]
    assert type(scene).__name__ in one_line(raised.value)


def test_a_name_that_is_like_no_other_lists_the_scenes_without_a_hint() -> None:
    with pytest.raises(SceneError) as raised:
        get_scene("qqq\nqqq")
    message = one_line(raised.value)
    assert "did you mean" not in message
    assert all(known in message for known in SCENES)


@pytest.mark.parametrize(
    ("option", "hint"),
    [("n_agent", "n_agents"), ("horizn", "horizon"), ("sensor_radios", "sensor_radius")],
)
@pytest.mark.parametrize("make", [get_scene, BatchedAreaSearch, AreaSearchEnv])
def test_an_unknown_option_gives_the_closest_match(make: type, option: str, hint: str) -> None:
    with pytest.raises(SceneError) as raised:
        make("hard", **{option: 3})
    message = one_line(raised.value)
    assert repr(option) in message
    assert f"did you mean {hint!r}" in message


@pytest.mark.parametrize("make", [BatchedAreaSearch, AreaSearchEnv])
def test_an_unknown_sub_goal_gives_the_closest_match(make: type) -> None:
    with pytest.raises(ValueError, match="did you mean 'nearest'") as raised:
        make("hard", sub_goal="neares")
    assert "none, nearest, assigned, routes" in one_line(raised.value)


@pytest.mark.parametrize("n_teams", [0, -1, 1.0, "2", True, None])
def test_a_bad_number_of_teams(n_teams: object) -> None:
    with pytest.raises(ValueError, match="n_teams") as raised:
        BatchedAreaSearch("hard", n_teams)  # type: ignore[arg-type]
    assert repr(n_teams) in one_line(raised.value)


@pytest.mark.parametrize(
    "options",
    [
        *({field: low} for field, (low, _) in (INTEGER_RANGES | NUMBER_RANGES).items() if low),
        *({field: high} for field, (_, high) in (INTEGER_RANGES | NUMBER_RANGES).items()),
        *({field: 0} for field, (low, _) in NUMBER_RANGES.items() if not low),
        {"free_fraction": 1},
        {"n_targets": 375},
        {"explore_normalizer": 1e-9},
        {"reward_sharing": "same_role"},
    ],
    ids=str,
)
def test_the_ends_of_the_ranges_are_valid(options: dict[str, float]) -> None:
    room = {"n_targets": 1} | options
    scene = get_scene("hard", **room)
    assert {field: getattr(scene, field) for field in room} == room


@pytest.mark.parametrize(
    "options",
    [
        {"height": 5, "width": 5, "free_fraction": 1e-12, "n_targets": 1},
        {"height": 5, "width": 5, "free_fraction": 1.0, "n_targets": 25},
        {"height": 5, "width": 90, "sensor_radius": 32.0, "view_radius": 32, "n_targets": 9},
        {"height": 6, "width": 5, "sensor_radius": 0.0, "view_radius": 1, "n_targets": 9},
        {"spawn_sigma": 1e6, "communication_radius": 0.0, "n_agents": 9},
        {"spawn_sigma": 0.0, "communication_radius": 1e6, "horizon": 1, "n_agents": 9},
        {"n_agents": 1024, "n_targets": 375},
    ],
    ids=str,
)
@pytest.mark.parametrize("sub_goal", ["none", "assigned"])
def test_extreme_scenes_can_be_played(options: dict[str, float], sub_goal: str) -> None:
    batch = BatchedAreaSearch("hard", 2, sub_goal, **options)
    batch.reset(3)
    rng = np.random.default_rng(4)
    for _ in range(3):
        batch.step(rng.integers(0, 5, (2, batch.n_agents)))
    state = batch.observations["state"]
    assert (state[:, 0].sum(axis=(1, 2)) == batch.scene.n_obstacles).all()
    assert (state[0, 3] * state[0, 0]).sum() == 0
    assert batch.observation_space.contains(
        {
            key: value[0] if key in batch.team_observation_keys else value[0, 0]
            for key, value in batch.observations.items()
        }
    )


@pytest.mark.parametrize(
    ("fraction", "height", "width", "n_free"),
    [(0.1 + 0.2, 10, 10, 30), (0.49, 25, 25, 307), (1.0, 7, 31, 217), (1 / 3, 6, 6, 12)],
)
def test_free_cells_round_up_but_not_for_noise(
    fraction: float, height: int, width: int, n_free: int
) -> None:
    scene = Scene(height=height, width=width, free_fraction=fraction, n_targets=1)
    assert scene.n_free == n_free
