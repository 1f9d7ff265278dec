"""Live figures of all states: in one file, linked between panels, in a real browser."""

import json
import re
import shutil
import subprocess

import numpy as np
import pytest

import snrmjax as sj
from snrmjax.report.figures.state_explorer import FoldedRecord, state_explorer
from snrmjax.report.html import Report, Section, report_html

CHROMIUM = shutil.which("chromium")


@pytest.fixture(scope="module")
def data():
    """Two levels of a linear mode at 10 Hz."""
    frequency = 2 * np.pi * np.tile([9.9, 10.0, 10.1], 2)
    force = np.repeat([1.0, 2.0], 3)
    velocity = force / (1 + 1j * np.tile([-1.0, 0.0, 1.0], 2))
    return sj.measure.steady_states(
        np.repeat([1, 2], 3), frequency, force, velocity, sensors=("tip",)
    )


def folded(data, k):
    """A record of a state whose velocity has a third harmonic and whose force a second one."""
    phase = np.linspace(0, 2 * np.pi, 300, endpoint=False)
    force, velocity = float(data.force[k]), complex(data.velocity[k, 0])
    f, v = np.array([0, force, 0.1 * force, 0]), np.array([0, velocity, 0, 0.2 * velocity])
    turn = np.exp(1j * np.arange(4)[:, None] * phase)
    return FoldedRecord(phase, (f @ turn).real, (v @ turn).real, f, v, (0, 1, 2, 3))


@pytest.fixture(scope="module")
def page(data):
    records = [None if k == 1 else folded(data, k) for k in range(6)]
    live = state_explorer(data, records=records)
    return report_html(Report("All states", sections=[Section("States", live=live)]))


def test_a_page_holds_all_that_it_needs(page):
    head, body = page.split("</head>")
    assert "script-src 'unsafe-inline'" in head
    assert not re.search(r"<(script|link|img)[^>]+(src|href)=[\"']http", page)
    assert all(f"level {k}" in body for k in (1, 2))
    assert len(page) < 1.6e6


def test_a_page_without_live_figures_runs_no_script():
    assert "<script" not in report_html(Report("Nothing live"))


def test_as_many_records_as_states(data):
    with pytest.raises(ValueError, match="one a state, 6, but are 1"):
        state_explorer(data, records=[folded(data, 0)])


def test_without_bokeh_it_says_what_to_install(data, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"pip install 'snrmjax\[lab\]'"):
        state_explorer(data)


ACTIONS = """
<pre id="answer"></pre>
<script>
const settled = () => new Promise(done => setTimeout(done, 300));
setTimeout(async () => {
  const models = [...Bokeh.documents[0].all_models];
  const titles = () => models.filter(m => m.type == "Title").map(m => m.text);
  const answer = {before: titles()};
  const states = models.find(m => m.type == "ColumnDataSource" && m.data.level !== undefined);
  states.selected.indices = [3];
  await settled();
  answer.after = titles();
  const shown = models.filter(m => m.type == "ColumnDataSource" && m.data.order !== undefined);
  answer.shares = shown.map(m => Array.from(m.data.share)).sort((a, b) => a.length - b.length)[0];
  states.selected.indices = [1];
  await settled();
  answer.none = titles();
  const drawn = models.filter(m => m.type == "GlyphRenderer" && m.data_source === states);
  drawn[0].visible = false;
  await settled();
  answer.hidden = drawn.filter(m => !m.visible).length;
  answer.drawn = drawn.length;
  document.getElementById("answer").textContent = JSON.stringify(answer);
}, 1500);
</script>
</body>
"""


@pytest.mark.long
@pytest.mark.skipif(CHROMIUM is None, reason="needs the program chromium to look at a page")
def test_a_browser_shows_the_record_of_the_state_that_is_tapped(page, tmp_path):
    file = tmp_path / "page.html"
    file.write_text(page.replace("</body>", ACTIONS), encoding="utf-8")
    quiet = ("gpu", "quic", "background-networking", "component-update", "sync")
    options = [f"--disable-{name}" for name in quiet]
    command = [CHROMIUM, "--headless", "--no-sandbox", *options, "--no-first-run"]
    command += [f"--user-data-dir={tmp_path / 'profile'}", "--virtual-time-budget=6000"]
    shown = subprocess.run(
        [*command, "--dump-dom", file.as_uri()], capture_output=True, text=True, timeout=60
    )
    found = re.search(r'<pre id="answer">([^<]+)</pre>', shown.stdout)
    answer = json.loads(found.group(1))
    # At first the state that moves most: level 2 at resonance.
    assert "Velocity: level 2, 10.0000 Hz" in answer["before"]
    assert "Velocity: level 2, 9.9000 Hz" in answer["after"]
    assert answer["fractions"][1:] == pytest.approx([10.0, 0.0], abs=1e-4)
    assert "Velocity of no record: level 1, 10.0000 Hz" in answer["none"]
    # Level 1 is hidden in all three panels, level 2 in none.
    assert (answer["hidden"], answer["drawn"]) == (3, 6)
