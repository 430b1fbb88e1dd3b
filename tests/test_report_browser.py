"""The report in a real browser: Debian's Chromium, headless, on a file without a network."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from report_pages import SVG, entrants, make, small_plan, small_tables, tables_with_a_time

from area_search import BatchedAreaSearch
from area_search.scenes import get_scene
from sb3_roles.evaluation.episodes import Player, held_out_seed, run_episodes
from sb3_roles.evaluation.metrics import MEANINGS
from sb3_roles.evaluation.report.page import write_report
from sb3_roles.evaluation.report.traces import record_traces

webdriver = pytest.importorskip("selenium.webdriver", reason="needs the extra browser (selenium)")
from selenium.webdriver.common.by import By  # noqa: E402
from selenium.webdriver.common.keys import Keys  # noqa: E402
from selenium.webdriver.support.ui import Select, WebDriverWait  # noqa: E402

CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
pytestmark = pytest.mark.skipif(
    CHROMIUM is None or DRIVER is None, reason="needs chromium and chromedriver (chromium-driver)"
)
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
PHONE = (360, 740)
# Pixels are read from a copy: reading back slows a canvas down, and Chromium says so.
COPY = (
    "const canvas = document.querySelector('.pane canvas');"
    "const copy = new OffscreenCanvas(canvas.width, canvas.height);"
    "const g = copy.getContext('2d', {willReadFrequently: true}); g.drawImage(canvas, 0, 0);"
)


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> str:
    plan = small_plan()
    path = tmp_path_factory.mktemp("report") / "report.html"
    traces = record_traces(plan, entrants(), make, (0, 1))
    facts = {"Version": "1.2", "Training": ["one", "two"]}
    write_report(
        path, plan, small_tables(plan), {"episode": SVG}, {"episode": "A"}, traces, facts, True
    )
    return path.as_uri()


@pytest.fixture(scope="module")
def driver(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for flag in FLAGS:
        options.add_argument(flag)
    options.add_argument(f"--user-data-dir={tmp_path_factory.mktemp('profile')}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    browser = webdriver.Chrome(options=options, service=Service(DRIVER))
    # A window of its own would have the focus; events of focus depend on it.
    browser.execute_cdp_cmd("Emulation.setFocusEmulationEnabled", {"enabled": True})
    yield browser
    browser.quit()


@pytest.fixture
def page(driver: Any, address: str) -> Iterator[Any]:
    """The page, freshly opened at a desktop's width; afterwards the console must be empty."""
    size(driver, 1280, 900)
    # Another document first: the same one with another hash would not be loaded anew.
    driver.get("about:blank")
    driver.get_log("browser")
    driver.get(address)
    yield driver
    assert [entry["message"] for entry in driver.get_log("browser")] == []


def size(driver: Any, width: int, height: int, **more: Any) -> None:
    metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False, **more}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)


def one(page: Any, css: str) -> Any:
    return page.find_element(By.CSS_SELECTOR, css)


def many(page: Any, css: str) -> list[Any]:
    return page.find_elements(By.CSS_SELECTOR, css)


def texts(page: Any, css: str) -> list[str]:
    """Texts of all elements that fit, at once."""
    found = "return [...document.querySelectorAll(arguments[0])].map(one => one.innerText)"
    return page.execute_script(found, css)


def panes(page: Any) -> list[dict[str, str]]:
    """What the visible panes of the player show."""
    return page.execute_script(
        "return [...document.querySelectorAll('.pane')].filter(p => !p.hidden)"
        ".map(p => ({...p.dataset}))"
    )


def step(page: Any) -> int:
    shown = {int(pane["step"]) for pane in panes(page)}
    assert len(shown) == 1
    (now,) = shown
    assert one(page, "#step-text").text == f"step {now} / 50"
    assert one(page, "#scrub").get_attribute("value") == str(now)
    return now


def scrub(page: Any, to: int) -> None:
    page.execute_script(
        "const s = document.getElementById('scrub'); s.value = arguments[0];"
        "s.dispatchEvent(new Event('input', {bubbles: true}))",
        to,
    )


def choose(page: Any, name: str, value: object) -> None:
    Select(one(page, f"#player-{name}")).select_by_value(str(value))


def chosen(page: Any) -> list[str]:
    return [
        str(one(page, f"#player-{name}").get_attribute("value"))
        for name in ("row", "scene", "n", "episode")
    ]


# Player


def test_buttons(page: Any) -> None:
    assert step(page) == 0
    one(page, "#forward").click()
    one(page, "#forward").click()
    assert step(page) == 2
    one(page, "#back").click()
    assert step(page) == 1
    one(page, "#last").click()
    assert step(page) == 50
    one(page, "#forward").click()
    assert step(page) == 50
    one(page, "#first").click()
    one(page, "#back").click()
    assert step(page) == 0


def test_play_and_pause(page: Any) -> None:
    play = one(page, "#play")
    Select(one(page, "#speed")).select_by_value("20")
    assert play.get_attribute("aria-label") == "Play"
    play.click()
    assert play.get_attribute("aria-label") == "Pause"
    WebDriverWait(page, 20).until(lambda _: int(panes(page)[0]["step"]) >= 3)
    play.click()
    assert play.get_attribute("aria-label") == "Play"
    paused = step(page)
    assert 3 <= paused < 50
    frames = "requestAnimationFrame(() => requestAnimationFrame(() => done()))"
    page.execute_async_script(f"const done = arguments[0]; {frames}")
    assert step(page) == paused
    # It plays on to the end, stops there, and begins anew.
    play.click()
    WebDriverWait(page, 30).until(lambda _: play.get_attribute("aria-label") == "Play")
    assert step(page) == 50
    play.click()
    WebDriverWait(page, 20).until(lambda _: int(panes(page)[0]["step"]) < 50)
    play.click()


def test_scrubbing_pauses(page: Any) -> None:
    one(page, "#play").click()
    scrub(page, 31)
    assert step(page) == 31
    assert one(page, "#play").get_attribute("aria-label") == "Play"
    one(page, "#scrub").send_keys(Keys.ARROW_RIGHT)
    assert step(page) == 32


def test_keyboard(page: Any) -> None:
    stage = one(page, ".panes")
    stage.send_keys(Keys.ARROW_RIGHT, Keys.ARROW_RIGHT, Keys.ARROW_LEFT)
    assert step(page) == 1
    stage.send_keys(Keys.END)
    assert step(page) == 50
    stage.send_keys(Keys.HOME)
    assert step(page) == 0
    before = page.execute_script("return scrollY")
    stage.send_keys(Keys.SPACE)
    assert one(page, "#play").get_attribute("aria-label") == "Pause"
    stage.send_keys(Keys.SPACE)
    assert one(page, "#play").get_attribute("aria-label") == "Play"
    assert page.execute_script("return scrollY") == before
    # Space on a button presses that button, once.
    one(page, "#forward").send_keys(Keys.SPACE)
    assert one(page, "#play").get_attribute("aria-label") == "Play"
    # Focus can be seen, and the live text tells where we are.
    assert page.execute_script("return document.activeElement.matches(':focus-visible')")
    assert f"step {step(page)}: explored" in one(page, "#live").get_attribute("textContent")


def frontier_and_links(row: str, episode: int, n_steps: int) -> tuple[list[int], list[int]]:
    """Count frontier cells and linked pairs before and after every step, by the simulation."""
    scene = get_scene("hard", n_agents=2)
    batch = BatchedAreaSearch(scene, 1)
    batch.reset([held_out_seed(small_plan().seed)], episode)
    player = Player(make(entrants()[row][0]), batch)
    frontier, links = [], []
    for t in range(n_steps + 1):
        shown = batch.snapshot(0)
        frontier.append(int(shown.frontier.sum()))
        apart = np.linalg.norm(shown.position[0] - shown.position[1])
        links.append(int(apart < scene.communication_radius))
        if t < n_steps:
            player.step()
    return frontier, links


@pytest.mark.parametrize("row", ["greedy_assigned", "hmappo"])
def test_what_the_page_computes_is_in_the_records(page: Any, row: str) -> None:
    records = run_episodes(
        make(entrants()[row][0]), "hard", 2, held_out_seed(small_plan().seed), n_agents=2
    )
    choose(page, "row", row)
    choose(page, "scene", "hard")
    for episode in (0, 1):
        choose(page, "episode", episode)
        frontier, links = frontier_and_links(row, episode, 50)
        for t in (0, 1, 2, 13, 37, 50):
            scrub(page, t)
            (pane,) = panes(page)
            assert (pane["row"], int(pane["step"])) == (row, t)
            assert (int(pane["frontier"]), int(pane["links"])) == (frontier[t], links[t])
            if t == 0:
                assert pane["seen"] == pane["covered"] == "0" and int(pane["seenFree"]) > 0
                continue
            for name, key in (("seen", "seen"), ("seen_free", "seenFree"), ("covered", "covered")):
                assert int(pane[key]) == records.counts[name][episode, t - 1]
            told = texts(page, ".pane:first-child .numbers dd")
            assert told == [f"{100 * curve[episode, t - 1]:.1f} %" for curve in curves_of(records)]


def curves_of(records: Any) -> list[np.ndarray]:
    return [records.curves[name] for name in ("explo_paper", "explo_true", "cover")]


def test_maps_are_drawn(page: Any) -> None:
    """Colors in the middle of cells: unknown at first, and what is hidden on demand."""
    choose(page, "row", "oracle")
    choose(page, "scene", "hard")
    read = (
        f"{COPY} const n = canvas.width / 25, all = [];"
        "for (let y = 0; y < 25; y++) for (let x = 0; x < 25; x++)"
        " all.push([...g.getImageData((x + .5) * n, (y + .5) * n, 1, 1).data].join());"
        "return all"
    )
    before = page.execute_script(read)
    one(page, "#show-hidden").click()
    after = page.execute_script(read)
    one(page, "#last").click()
    ended = page.execute_script(read)
    scene = get_scene("hard", n_agents=2)
    batch = BatchedAreaSearch(scene, 1)
    batch.reset([held_out_seed(small_plan().seed)], 0)
    start = batch.snapshot(0)
    unknown = max(set(before), key=before.count)
    known = int(start.explored.sum())
    assert before.count(unknown) == 625 - known
    # Obstacles and open targets that nobody has seen.
    told = (start.obstacle | start.target_open) & ~start.explored
    changed = [a != b for a, b in zip(before, after, strict=True)]
    assert np.array_equal(np.array(changed).reshape(25, 25), told)
    assert ended.count(unknown) < before.count(unknown)


def test_roles_have_letters_and_a_legend(page: Any) -> None:
    choose(page, "row", "hmappo")
    keys = [key.text for key in many(page, ".role-keys .key")]
    assert [key.split()[0] for key in keys] == ["E", "C"]
    assert "explore" in keys[0] and "cover" in keys[1]
    choose(page, "row", "greedy")
    assert ["without roles" in key.text for key in many(page, ".role-keys .key")] == [True]


def test_two_methods_in_step(page: Any) -> None:
    choose(page, "row", "hmappo")
    assert len(panes(page)) == 1
    one(page, "#player-compare").click()
    assert [pane["row"] for pane in panes(page)] == ["hmappo", "greedy_assigned"]
    choose(page, "other", "greedy")
    assert [pane["row"] for pane in panes(page)] == ["hmappo", "greedy"]
    canvases = [canvas for canvas in many(page, ".pane canvas") if canvas.is_displayed()]
    assert len(canvases) == 2
    one(page, "#last").click()
    assert step(page) == 50
    one(page, "#back").click()
    first, second = panes(page)
    assert first["step"] == second["step"] == "49" and first["seen"] != second["seen"]
    # The same episode for both, whatever is chosen then; a method is not compared with itself.
    choose(page, "episode", 1)
    choose(page, "row", "greedy")
    assert [pane["row"] for pane in panes(page)] == ["greedy", "greedy_assigned"]
    one(page, "#player-compare").click()
    assert len(panes(page)) == 1


def test_the_address_keeps_the_choice(page: Any, address: str) -> None:
    page.get("about:blank")
    page.get(f"{address}#player=greedy,easy,2,1,oracle")
    assert chosen(page) == ["greedy", "easy", "2", "1"]
    assert [pane["row"] for pane in panes(page)] == ["greedy", "oracle"]
    top = page.execute_script(
        "return document.getElementById('player').getBoundingClientRect().top"
    )
    assert abs(top) < 120
    choose(page, "scene", "hard")
    assert page.current_url.endswith("#player=greedy,hard,2,1,oracle")
    page.execute_script("location.hash = '#player=hmappo,easy,2,0'")
    WebDriverWait(page, 10).until(lambda _: chosen(page) == ["hmappo", "easy", "2", "0"])
    assert len(panes(page)) == 1
    # What does not exist changes nothing.
    for wrong in ("nobody,easy,2,0", "hmappo,easy,9,0", "%E0%A4%A", "", ",,,"):
        page.execute_script("location.hash = arguments[0]", f"#player={wrong}")
    assert chosen(page) == ["hmappo", "easy", "2", "0"]


# Tables


def rows(page: Any, table: str = "#table-I") -> list[str]:
    return [str(row.get_attribute("data-row")) for row in many(page, f"{table} tbody tr")]


def header(page: Any, key: str) -> Any:
    return one(page, f'#table-I th[data-key="{key}"]')


def test_sorting(page: Any) -> None:
    plain = ["greedy", "greedy_assigned", "hmappo", "oracle"]
    assert rows(page) == plain
    header(page, "easy:explo_paper").find_element(By.TAG_NAME, "button").click()
    assert rows(page) == ["hmappo", "greedy_assigned", "greedy", "oracle"]
    assert header(page, "easy:explo_paper").get_attribute("aria-sort") == "descending"
    # The button has kept the focus, and Enter sorts the other way round; the bound stays last.
    page.switch_to.active_element.send_keys(Keys.ENTER)
    assert rows(page) == ["greedy", "greedy_assigned", "hmappo", "oracle"]
    assert header(page, "easy:explo_paper").get_attribute("aria-sort") == "ascending"
    header(page, "hard:cover").find_element(By.TAG_NAME, "button").click()
    assert rows(page) == ["greedy_assigned", "greedy", "hmappo", "oracle"]
    assert header(page, "easy:explo_paper").get_attribute("aria-sort") == "none"
    header(page, "order").find_element(By.TAG_NAME, "button").click()
    assert rows(page) == plain


def metrics_shown(page: Any) -> set[str]:
    keys = [str(one.get_attribute("data-key")) for one in many(page, "#table-I thead th[data-key]")]
    return {key.split(":")[1] for key in keys if ":" in key}


def test_choice_of_metrics(page: Any) -> None:
    assert metrics_shown(page) == {"explo_paper", "cover"}
    one(page, "#which input[value=true]").click()
    assert metrics_shown(page) == {"explo_true", "cover"}
    one(page, "#which input[value=both]").click()
    assert metrics_shown(page) == {"explo_paper", "explo_true", "cover"}


def test_cells_say_what_they_are(page: Any) -> None:
    cells = many(page, '#table-I tr[data-row="greedy"] td')
    assert cells[0].text.split() == ["60.0", "±1.0", "70.0", "\N{MINUS SIGN}10.0"]
    # Both are 100 % or more.
    assert cells[2].text.split() == ["120.0", "±1.0", "≥100", "✓"]
    tip = one(page, "#tip")
    assert not tip.is_displayed()
    page.execute_script("arguments[0].focus()", cells[0])
    lines = tip.text.splitlines()
    assert lines[0] == "Greedy, Easy, 2 robots"
    for line in (
        "mean 60.0 %",
        "95 % interval 59.0 to 61.0",
        "the paper prints 70",
        "20 episodes",
        "2 µs to decide on a step",
        "(a team\N{RIGHT SINGLE QUOTATION MARK}s share, up to 20 teams at once)",
    ):
        assert line in lines
    assert cells[0].get_attribute("aria-describedby") == "tip"
    box = page.execute_script(
        "const b = arguments[0].getBoundingClientRect();return b.toJSON()", tip
    )
    assert box["left"] >= 0 and box["right"] <= 1280 and box["top"] >= 0
    # Arrow keys move from cell to cell, and Escape closes.
    page.switch_to.active_element.send_keys(Keys.ARROW_DOWN, Keys.ARROW_DOWN)
    lines = tip.text.splitlines()
    assert lines[0] == "Roles, Easy, 2 robots" and "2 runs of 1,000 joint steps" in lines
    assert "20 episodes, each by 2 training seeds" in lines
    page.switch_to.active_element.send_keys(Keys.ESCAPE)
    assert not tip.is_displayed()
    webdriver.ActionChains(page).move_to_element(cells[1]).perform()
    assert tip.is_displayed() and "Targets covered" in tip.text


def test_from_a_cell_to_its_episode(page: Any) -> None:
    cell = many(page, '#table-I tr[data-row="oracle"] td')[2]
    page.execute_script("arguments[0].focus()", cell)
    cell.send_keys(Keys.ENTER)
    assert chosen(page) == ["oracle", "hard", "2", "0"]
    assert page.switch_to.active_element.get_attribute("class").startswith("panes")


# The rest of the page


def test_head_and_honesty(page: Any) -> None:
    assert one(page, "#quick").is_displayed()
    assert len(many(page, "#points .point")) == 6
    assert texts(page, "#facts dd") == ["1.2", "one\ntwo"]
    assert page.execute_script("return document.querySelector('.figures img').naturalWidth") > 0
    # A label of the plan is text, whatever it holds.
    names = texts(page, "#table-I tbody th span")
    assert any("</script><img" in name for name in names)
    assert len(many(page, "img")) == 1
    shown = len(many(page, ".deviation"))
    one(page, '#honesty input[value="released code"]').click()
    badges = set(texts(page, ".deviation .source"))
    assert badges == {"released code"} and 0 < len(many(page, ".deviation")) < shown
    printed = [row.split("\t") for row in texts(page, "#printed tbody tr")]
    assert printed[0][3:6] == ["40.0", "65.0", "+25.0"] and len(printed) == 7
    one(page, "#printed-short").click()
    assert len(many(page, "#printed tbody tr")) == 3
    Select(one(page, "#printed-row")).select_by_value("greedy")
    assert len(many(page, "#printed tbody tr")) == 1


def test_a_time_that_is_never_reached_is_a_dash_and_falls_short(page: Any, tmp_path: Path) -> None:
    plan = small_plan()
    path = tmp_path / "report.html"
    write_report(path, plan, tables_with_a_time(plan), {}, {}, [], {}, False)
    page.get(path.as_uri())
    first = texts(page, "#printed tbody tr")[0].split("\t")
    dash = "\N{EN DASH}"
    assert first == ["Roles", "Easy, 2", "Time_E (paper)", "39", dash, dash, "I"]
    assert len(many(page, "#printed tbody tr")) == 8
    hint = next(text for text in texts(page, "#honesty .hint") if "numbers are printed" in text)
    assert "8 numbers are printed; 8 of them were played, and ours falls short of 4." in hint
    one(page, "#printed-short").click()
    assert len(many(page, "#printed tbody tr")) == 4


def test_what_metrics_mean(page: Any) -> None:
    meanings = dict(zip(texts(page, ".meanings dt"), texts(page, ".meanings dd"), strict=True))
    assert set(meanings) == set(MEANINGS)
    for name, text in meanings.items():
        said = text.replace("\N{NO-BREAK SPACE}", " ")
        assert said == MEANINGS[name].text[0].upper() + MEANINGS[name].text[1:] + "."


def test_a_phone(page: Any) -> None:
    size(page, *PHONE, mobile=True)
    for script in ("", "document.getElementById('player-compare').click()"):
        page.execute_script(script)
        widths = page.execute_script("return [document.documentElement.scrollWidth, innerWidth]")
        assert widths[0] <= widths[1] == PHONE[0]
    one(page, "#which input[value=both]").click()
    assert page.execute_script("return document.documentElement.scrollWidth") <= PHONE[0]
    # Tables scroll in boxes of their own.
    inner, outer = page.execute_script(
        "const box = document.querySelector('#table-I .scroll');"
        "return [box.scrollWidth, box.clientWidth]"
    )
    assert inner > outer
    sizes = [canvas.size["width"] for canvas in many(page, ".pane canvas")]
    assert all(200 < width <= PHONE[0] for width in sizes)


def emulate(page: Any, **features: str) -> None:
    found = [
        {"name": f"prefers-{name.replace('_', '-')}", "value": value}
        for name, value in features.items()
    ]
    page.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": found})


def test_dark(page: Any) -> None:
    read = (
        f"{COPY} const color = getComputedStyle(document.body).backgroundColor;"
        "return [color, [...g.getImageData(2, 2, 1, 1).data].join()]"
    )
    light = page.execute_script(read)
    emulate(page, color_scheme="dark")
    try:
        WebDriverWait(page, 10).until(lambda _: page.execute_script(read)[1] != light[1])
        background = page.execute_script(read)[0]
        assert sum(json.loads(background.replace("rgb(", "[").replace(")", "]"))) < 150
    finally:
        emulate(page)


@pytest.mark.parametrize("motion", ["reduce", "no-preference"])
def test_robots_glide_unless_less_motion_is_preferred(page: Any, motion: str) -> None:
    frames = (
        "const done = arguments[0], canvas = document.querySelector('.pane canvas');"
        "const start = performance.now(), seen = new Set();"
        "const look = () => { seen.add(canvas.toDataURL());"
        "  if (performance.now() - start < 300) requestAnimationFrame(look);"
        "  else done([seen.size, document.querySelector('.pane').dataset.step]); };"
        "document.getElementById('play').click(); requestAnimationFrame(look);"
    )
    emulate(page, reduced_motion=motion)
    try:
        choose(page, "row", "greedy_assigned")
        Select(one(page, "#speed")).select_by_value("1")
        pictures, now = page.execute_async_script(frames)
        assert now == "0"
        assert (pictures == 1) == (motion == "reduce")
    finally:
        emulate(page)


def test_connections_and_scripts_are_refused(driver: Any, address: str) -> None:
    driver.get("about:blank")
    driver.get(address)
    # No network is needed for the first: without the policy it would succeed.
    result = driver.execute_async_script(
        "const done = arguments[0]; const refused = [];"
        "addEventListener('securitypolicyviolation', e => refused.push(e.effectiveDirective));"
        "fetch('data:text/plain,hello').then(() => done('fetched'), () => {"
        "  const s = document.createElement('script'); s.textContent = 'window.ran = true';"
        "  document.body.append(s);"
        "  setTimeout(() => done([refused, window.ran || false]), 100); });"
    )
    assert result == [["connect-src", "script-src-elem"], False]
    driver.get_log("browser")


def test_a_page_without_anything(driver: Any, tmp_path: Path) -> None:
    path = tmp_path / "empty.html"
    write_report(path, small_plan(), {}, {}, {}, [], {}, False)
    driver.get("about:blank")
    driver.get_log("browser")
    driver.get(path.as_uri())
    assert "No episodes were recorded" in one(driver, "#player-body").text
    assert "No tables were made" in one(driver, "#table-list").text
    assert driver.get_log("browser") == []
