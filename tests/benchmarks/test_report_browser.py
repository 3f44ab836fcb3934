"""The report as a reader has it: in a headless Chromium, with keys and at two widths."""

from __future__ import annotations

import json

import numpy as np
import pytest

from lagros_benchmarks.report import tables
from lagros_benchmarks.report.page import assemble
from lagros_benchmarks.report.page.packed import unpacked
from lagros_benchmarks.report.records import summarise
from lagros_benchmarks.run.files import json_text
from lagros_benchmarks.run.runner import run_benchmark
from lagros_benchmarks.run.settings import BenchmarkSettings
from tests.benchmarks import browser as chromium
from tests.benchmarks import fakes

pytestmark = pytest.mark.skipif(chromium.PROGRAM is None, reason=chromium.MISSING)

HOSTILE = "</script><img src=x onerror=alert(1)>"
WIDTHS = (1280, 390)
# The picture of one side, as text that differs where any pixel does.
PICTURE = "document.querySelectorAll('.stage canvas[role=img]')[{}].toDataURL()"

# The share of pixels that are clearly otherwise on the two sides.
OTHERWISE = """(() => {
  const [one, other] = [...document.querySelectorAll(".stage canvas[role=img]")].map((canvas) => {
    const { width, height } = canvas;
    const copy = Object.assign(document.createElement("canvas"), { width, height });
    const pen = copy.getContext("2d", { willReadFrequently: true });
    pen.drawImage(canvas, 0, 0);
    return pen.getImageData(0, 0, width, height).data;
  });
  let count = 0;
  one.forEach((value, k) => { count += Math.abs(value - other[k]) > 96; });
  return count / one.length;
})()"""


class Hostile(fakes.LinearPolicy):
    """Raises a tag."""

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        if observation[12] > 0.45:
            raise ValueError(HOSTILE)
        return super().predict(observation, state, episode_start, deterministic)


@pytest.fixture(scope="module")
def toolbox():
    def make(name, env, settings):
        return Hostile() if name == HOSTILE else fakes.make_policy(name, env, settings)

    return fakes.Toolbox(make, fakes.easy_planner)


@pytest.fixture(scope="module")
def rows_and_page(tmp_path_factory, toolbox):
    settings = BenchmarkSettings(
        policies=("steady", "timid", "idle"), episodes=6, bounds=(0.3, 0.75)
    )
    run = run_benchmark(settings, fakes.EASY, policies={HOSTILE: Hostile()})
    rows = json.loads(json_text(summarise(run)))
    path = tmp_path_factory.mktemp("page") / "report.html"
    path.write_text(assemble.bench_page(run, rows, toolbox=toolbox), encoding="utf-8")
    return rows, path


@pytest.fixture(scope="module")
def opened(tmp_path_factory):
    with chromium.Browser(tmp_path_factory.mktemp("chromium")) as one:
        yield one


@pytest.fixture
def page(opened, rows_and_page):
    opened.open(rows_and_page[1])
    yield opened
    assert opened.problems == []


def cells(page, column=None):
    """The text of the table's body, or of one of its columns."""
    text = "[...document.querySelectorAll('#table tbody tr')].map((row) => "
    text += "[...row.cells].map((cell) => cell.textContent))"
    found = page.value(text)
    return found if column is None else [row[column] for row in found]


def click(page, selector):
    page.value(f"document.querySelector({json.dumps(selector)}).click()")


def set_value(page, selector, value):
    page.value(
        f"(() => {{ const one = document.querySelector({json.dumps(selector)});"
        f" one.value = {json.dumps(value)};"
        " one.dispatchEvent(new Event('input')); one.dispatchEvent(new Event('change')); })()"
    )


def clock(page):
    return page.value("Number(document.getElementById('time').value)")


def test_the_table_is_that_of_the_rows(page, rows_and_page):
    rows = [row for row in rows_and_page[0] if row["bound"] == 0.75]
    columns = tables.texts(rows[0]).columns(rows[0])
    expected = [[cell(row).strip() for _, _, cell in columns] for row in rows]
    found = cells(page)
    # The name of the policy has room here; kind and bound stand behind it.
    assert [[*row[3:]] for row in found] == [row[1:] for row in expected]
    assert [row[1:3] for row in found] == [["uniform", "0.75"]] * 4
    assert [row[0] for row in found[:3]] == ["steady", "timid", "idle"]
    click(page, "#all")
    assert len(cells(page)) == len(rows_and_page[0]) == 8
    set_value(page, "#bound", "0.3")
    click(page, "#all")
    assert {row[2] for row in cells(page)} == {"0.3"}


def test_a_column_sorts_by_its_numbers(page):
    click(page, "#all")
    head = "document.querySelectorAll('#table th')[{}]"
    names = page.value("[...document.querySelectorAll('#table th span')].map((s) => s.textContent)")
    effort = names.index("effort")
    before = cells(page, effort)
    for down, said in ((True, "descending"), (False, "ascending")):
        page.value(f"{head.format(effort)}.querySelector('button').click()")
        found = cells(page, effort)
        known = [float(one) for one in found if one != "–"]
        assert known == sorted(known, reverse=down)
        assert sorted(found) == sorted(before)
        assert page.value(f"{head.format(effort)}.getAttribute('aria-sort')") == said
    page.value(f"{head.format(0)}.querySelector('button').click()")
    assert cells(page, 0) == sorted(cells(page, 0), key=str.casefold)
    assert page.value(f"{head.format(effort)}.getAttribute('aria-sort')") == "none"


def test_names_and_errors_are_shown_as_they_are_and_never_run(page):
    assert page.value("document.images.length") == 0
    assert page.value("document.scripts.length") == 2
    text = page.value("document.body.innerText")
    assert HOSTILE in text
    set_value(page, "#policy-0", "3")
    assert HOSTILE in page.value("document.querySelector('.stage .warning').textContent")


def test_the_keys_play_and_step(page):
    page.value("document.querySelector('.stage canvas').focus()")
    first = page.value(PICTURE.format(0))
    page.press("ArrowRight")
    assert clock(page) == 1
    page.press("ArrowRight", shift=True)
    assert clock(page) == 11
    page.press("ArrowLeft")
    assert clock(page) == 10
    assert page.value(PICTURE.format(0)) != first
    page.press("End")
    assert clock(page) == page.value("Number(document.getElementById('time').max)") == fakes.STEPS
    page.press("Home")
    assert clock(page) == 0
    assert page.value(PICTURE.format(0)) == first
    page.press(" ")
    page.value(
        "new Promise((done) => { const look = () => Number(document.getElementById('time').value)"
        " > 4 ? done() : setTimeout(look, 20); look(); })"
    )
    page.press(" ")
    stopped = clock(page)
    assert 4 < stopped < fakes.STEPS
    assert "Play" in page.value("document.getElementById('play').textContent")
    page.value("new Promise((done) => setTimeout(done, 100))")
    assert clock(page) == stopped


def test_two_policies_fly_the_same_episode_beside_each_other(page):
    names = [
        page.value(f"document.querySelectorAll('.stage h3')[{k}].textContent") for k in range(2)
    ]
    assert names == ["steady", "timid"]
    # At the start all is alike, to the rounding of what is packed; later it is not.
    assert page.value(OTHERWISE) < 0.002
    set_value(page, "#time", "30")
    assert page.value(OTHERWISE) > 0.004
    set_value(page, "#policy-1", "0")
    assert page.value(OTHERWISE) == 0.0
    set_value(page, "#policy-1", "")
    assert page.value("document.querySelectorAll('.stage:not([hidden])').length") == 1


def test_every_episode_says_how_it_ended(page):
    data = page.value("JSON.parse(document.getElementById('data').textContent)")
    here = [one for one in data["episodes"] if one["condition"] == 1]
    idle = next(str(k) for k, one in enumerate(data["series"]) if one["name"] == "idle")
    for index, one in enumerate(here):
        set_value(page, "#episode", str(index))
        set_value(page, "#policy-0", idle)
        said = page.value("document.querySelector('.stage .verdict').textContent")
        ending = one["flights"][idle]["ending"]
        assert said.startswith(f"{ending['label']} after {ending['time']:.1f} s; ")
        assert said.endswith(one["flights"][idle]["text"])
        assert one["seed"] in page.value("document.getElementById('seed').textContent")


def test_the_states_that_are_shown_are_those_of_the_flight(page):
    data = page.value("JSON.parse(document.getElementById('data').textContent)")
    one = next(one for one in data["episodes"] if one["condition"] == 1)
    set_value(page, "#time", "20")
    said = page.value("document.querySelector('.stage .numbers').textContent").replace("−", "-")
    states = unpacked(one["flights"]["0"]["parts"]["states"])
    found = [float(part.split()[1]) for part in said.split(" · ") if part[:2] in ("p ", "th")]
    np.testing.assert_allclose(found, states[20, :2], atol=0.006)


@pytest.mark.parametrize("width", WIDTHS)
def test_nothing_is_cut_at_any_width(opened, rows_and_page, width):
    opened.open(rows_and_page[1], width)
    assert opened.value("document.documentElement.scrollWidth") <= width
    beyond = (
        "[...document.querySelectorAll('select, button, canvas, svg, h3, p')].filter((one) => "
        "!one.closest('.wide') && one.getBoundingClientRect().right > innerWidth + 1).length"
    )
    assert opened.value(beyond) == 0
    assert opened.value("document.querySelector('#charts svg').getBoundingClientRect().width") > 250
    assert opened.problems == []


def test_tab_goes_through_all_controls_in_their_order(page):
    order = "[...document.querySelectorAll('select, button, input, canvas[tabindex], .wide')]"
    shown = f"{order}.filter((one) => one.offsetParent !== null)"
    count = page.value(f"{shown}.length")
    page.value("document.activeElement.blur()")
    visited = []
    for _ in range(count):
        page.press("Tab")
        visited.append(page.value(f"{shown}.indexOf(document.activeElement)"))
        assert page.value("getComputedStyle(document.activeElement).outlineStyle") != "none"
    assert visited == list(range(count))


def test_it_prints_without_its_controls(page):
    page.ask("Emulation.setEmulatedMedia", media="print")
    hidden = "['choice', 'cast', 'controls'].map((id) => document.getElementById(id).offsetParent)"
    assert page.value(hidden) == [None] * 3
    assert page.value("document.getElementById('table').offsetParent") is not None
    found = page.ask("Page.printToPDF")["data"]
    page.ask("Emulation.setEmulatedMedia", media="")
    assert len(found) > 20_000
