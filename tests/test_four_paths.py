"""A stranger's four paths are on the pages, and lead where they say."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests import documents, four_paths
from tests.four_paths import PATHS, Step


@pytest.mark.parametrize("name", PATHS)
def test_the_pages_say_every_step(name: str) -> None:
    assert all(four_paths.said(step) for step in PATHS[name])


def test_a_step_that_no_page_says_is_missed() -> None:
    with pytest.raises(ValueError, match=r"index\.md has no command"):
        four_paths.said(Step("index.md", "^lagros nothing"))


@pytest.mark.parametrize(
    ("step", "message"),
    [
        (Step("page.md", "print"), None),
        (Step("page.md", "print", ("7",)), None),
        (Step("page.md", "print", ("8",)), "without"),
        (Step("page.md", "open", ("made.txt",)), None),
        (Step("page.md", "raise"), "no such luck"),
    ],
)
def test_a_step_must_end_well_and_show_what_it_should(
    step: Step, message: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    blocks = ("print(3 + 4)", "open('made.txt', 'w').close()", "raise SystemExit('no such luck')")
    page = tmp_path / "docs" / "page.md"
    page.parent.mkdir()
    page.write_text("\n".join(f"```python\n{block}\n```\n" for block in blocks))
    monkeypatch.setattr(four_paths, "ROOT", tmp_path)
    monkeypatch.setitem(PATHS, "one", (step,))
    if message is None:
        four_paths.walk("one", tmp_path)
    else:
        with pytest.raises(RuntimeError, match=message):
            four_paths.walk("one", tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", PATHS)
def test_a_path_leads_where_it_should(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for variable, value in documents.environment().items():
        monkeypatch.setenv(variable, value)
    four_paths.walk(name, tmp_path)
