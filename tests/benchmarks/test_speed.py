"""The micro-benchmarks run, peers or not; how fast anything is, no test says."""

import io
import json

import pytest
from rich.cells import cell_len
from rich.console import Console
from speed import environment, hold, network, planner, report, sdp, timing

TINY = timing.Scale(
    steps=20,
    plans=2,
    episodes=2,
    samples=(3,),
    designs=1,
    rounds=2,
    calls=2,
    tracked_episodes=1,
    worlds=3,
)


# Peers warn about their own affairs (torch.jit is deprecated).
@pytest.mark.filterwarnings("ignore")
def test_every_topic_gives_rows_and_a_file(tmp_path):
    topics = (planner, sdp, network, hold, environment)
    sections = [section for topic in topics for section in topic.sections(TINY)]
    assert len(sections) == 14
    assert all(section.rows for section in sections)
    shown = io.StringIO()
    console = Console(file=shown, width=report.WIDTH)
    for section in sections:
        report.print_section(console, section)
    report.print_targets(console, sections)
    text = shown.getvalue()
    assert max(map(cell_len, text.splitlines())) <= 80
    assert all(row.label in text for section in sections for row in section.rows)
    path = report.write_json(
        tmp_path / "speed.json", sections, report.surroundings(0.0), "the command"
    )
    assert len(json.loads(path.read_text())["sections"]) == len(sections)
