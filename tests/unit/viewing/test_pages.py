"""Replay and comparison in a real browser: no console errors, no network, numbers and places equal the files'."""

import asyncio
import json
import sys

import numpy as np
import pytest
from PIL import Image, ImageSequence

from drakerock.errors import InputError
from drakerock.loading.signal_table import load_signals
from drakerock.viewing.browser import open_page
from drakerock.viewing.film import FilmSettings, wait_until_ready, write_film
from drakerock.viewing.replay import write_comparison, write_replay
from drakerock.viewing.results import make_results
from drakerock.viewing.scene_figures import calc_rock_poses
from drakerock.viewing.stored_cycle import load_cycle
from tests.browsers import act, need_browser
from tests.cycle_files import write_cycle

SEEN = ("load", "payload_share", "push", "down", "hinge", "speed", "slip", "wheels", "boom", "bucket")

# What the page shows at a time: the panel's numbers, and where rocks and bodies are drawn.
LOOK = """(() => {
  const scene = replay.scenes[0], p = new THREE.Vector3(), matrix = new THREE.Matrix4();
  const rocks = scene.place.map((place, rock) => {
    scene.instances[scene.run.rock_shape[rock]].getMatrixAt(place, matrix);
    return [...p.setFromMatrixPosition(matrix).toArray(), matrix.getMaxScaleOnAxis()];
  });
  return { rocks, bodies: scene.bodies.map((b) => b.position.toArray()), drawn: scene.actual.geometry.instanceCount,
    values: Object.fromEntries([...document.querySelectorAll("[data-value]")]
      .map((e) => [e.dataset.value, e.textContent])),
    clock: document.getElementById("clock").textContent, mode: document.getElementById("mode").textContent,
    eye: scene.viewer.camera.position.toArray(), wall: scene.wall.material.opacity, playing: replay.playing,
    faults: document.querySelectorAll(".fault").length };
})()"""


@pytest.fixture(scope="module")
def cycles(tmp_path_factory, plan, session_recording):
    place = tmp_path_factory.mktemp("pages")
    other = {"bucket_mass_kg": 9000.0, "objectives": {"production": 900.0, "damage": 0.5, "debris": 0.0}}
    first = write_cycle(place / "first", plan, session_recording)
    return first, write_cycle(place / "second", plan, session_recording, other)


@pytest.fixture(scope="module")
def seen(cycles):
    """What one visit of each page shows, by what was done there."""
    need_browser()

    async def visit():
        async with open_page(write_replay(cycles[0]), 640, 400) as page:
            await wait_until_ready(page)
            looks = {"playing": await page.evaluate(LOOK)}
            steps = {
                "start": "replay.setPlaying(false); replay.seek(0)",
                "slid": act("#time", "input", 4.0),
                "later": "replay.seek(6.6)",
                "cut": act("#cut", "input", 1),
                "walled": act("#cut", "input", 0) + act("#wall", "input", 0.4),
                **{
                    name: act(f"[data-camera={name}]", "click")
                    for name in ("top", "driver", "bucket", "side")
                },
                "played": act("#speed", "change", 4) + act("#play", "click"),
            }
            for name, step in steps.items():
                await page.evaluate(step)
                looks[name] = await page.evaluate(LOOK)
            looks["faults"] = page.faults
        path = cycles[0].parent / "compare.html"
        write_comparison(cycles, path)
        async with open_page(path, 640, 400) as page:
            await wait_until_ready(page)
            await page.evaluate("replay.setPlaying(false); replay.seek(4)")
            looks["compared"] = await page.evaluate(LOOK)
            rows = "[...document.querySelectorAll('#results tr[data-key]')].map((r) => [r.dataset.key, "
            looks["table"] = dict(
                await page.evaluate(
                    rows + "[...r.querySelectorAll('td')].slice(1).map((d) => d.textContent)])"
                )
            )
            looks["compare faults"] = page.faults
        return looks

    return asyncio.run(visit())


def test_pages_open_without_faults_and_play(seen):
    assert seen["faults"] == []
    assert seen["compare faults"] == []
    assert seen["playing"]["playing"]
    assert not seen["slid"]["playing"], "who slides wants to look"
    assert seen["played"]["playing"]
    assert all(look["faults"] == 0 for look in seen.values() if isinstance(look, dict) and "faults" in look)


@pytest.mark.parametrize(("name", "time"), [("start", 0.0), ("slid", 4.0), ("later", 6.6)])
def test_numbers_are_those_of_the_files(seen, cycles, name, time):
    s, _ = load_signals(cycles[0] / "signals.parquet")
    row = round(time / 0.01)
    expected = {
        "load": s["bucket_load"][row] / 1e3, "payload_share": s["bucket_load"][row] / 210.0,
        "push": -s["bucket_force_x"][row] / 1e3, "down": -s["bucket_force_z"][row] / 1e3,
        "hinge": s["hinge_moment"][row] / 1e3, "speed": s["v_F"][row], "slip": s["wheel_slip"][row],
        **{motor: s[f"torque_{motor}"][row] / 1e3 for motor in ("wheels", "boom", "bucket")},
    }  # fmt: skip
    assert set(expected) == set(SEEN)
    for key, value in expected.items():
        shown = seen[name]["values"][key]
        digits = len(shown.partition(".")[2])
        assert float(shown) == pytest.approx(value, abs=0.5001 * 10**-digits + 1e-6 * abs(value)), key
    assert seen[name]["clock"].startswith(f"{time:.2f} of 8.00")


@pytest.mark.parametrize(("name", "frame"), [("start", 0), ("slid", 2)])
def test_rocks_and_machine_are_where_the_recording_has_them(seen, cycles, name, frame):
    recording = load_cycle(cycles[0]).recording
    rocks = np.array(seen[name]["rocks"])
    assert np.abs(rocks[:, :3] - calc_rock_poses(recording, frame)[:, 4:]).max() < 0.012
    assert rocks[:, 3] == pytest.approx(recording.rock_size, rel=1e-3)
    assert np.abs(np.array(seen[name]["bodies"]) - recording.X_WBs[frame, :, 4:]).max() < 0.003


def test_buttons_and_sliders_act(seen):
    eyes = [tuple(np.round(seen[name]["eye"], 3)) for name in ("side", "top", "driver", "bucket")]
    assert len(set(eyes)) == 4
    assert eyes[0] == tuple(np.round(seen["start"]["eye"], 3)), "the page opens with the side view"
    rocks = np.array(seen["cut"]["rocks"])
    hidden = rocks[:, 3] == 0
    assert np.array_equal(hidden, rocks[:, 1] < 0.0)
    assert 0 < hidden.sum() < len(rocks)
    assert np.all(np.array(seen["walled"]["rocks"])[:, 3] > 0)
    assert seen["walled"]["wall"] == 0.4
    assert 0 == seen["start"]["drawn"] < seen["slid"]["drawn"] < seen["later"]["drawn"]
    assert [seen[name]["mode"] for name in ("start", "slid", "later")] == ["approach", "s1 to s2", "s3 to s4"]


def test_comparison_shows_both_loadings(seen, cycles):
    results = [{r.key: r for r in make_results(load_cycle(folder))} for folder in cycles]
    for key, cells in seen["table"].items():
        assert cells[:2] == [result[key].show() for result in results]
    assert seen["table"]["load"] == ["8.40", "9.00", "+0.60"]
    assert {f"{run}.{key}" for run in "AB" for key in SEEN} <= set(seen["compared"]["values"])


def test_films_hold_a_picture_for_each_moment(cycles, tmp_path):
    need_browser()
    settings = FilmSettings(fps=1.0, speed=4.0, width=240, height=160)
    write_film(cycles[0], tmp_path / "film.gif", settings)
    with Image.open(tmp_path / "film.gif") as picture:
        frames = [np.asarray(frame.convert("L"), float) for frame in ImageSequence.Iterator(picture)]
    assert len(frames) == 3  # 0, 4 and 8 s
    assert {frame.shape for frame in frames} == {(160, 240)}
    assert min(frame.std() for frame in frames) > 10
    assert np.abs(frames[1] - frames[0]).max() > 50


@pytest.mark.parametrize(
    ("path", "size", "message"), [("film.avi", 240, ".mp4, .gif"), ("film.gif", 241, "even")]
)
def test_film_that_cannot_be_made_is_refused(cycles, tmp_path, path, size, message):
    with pytest.raises(InputError, match=message):
        write_film(cycles[0], tmp_path / path, FilmSettings(width=size))


@pytest.mark.parametrize(("package", "ending"), [("choreographer", ".gif"), ("imageio_ffmpeg", ".mp4")])
def test_what_a_film_needs_is_said(cycles, tmp_path, monkeypatch, package, ending):
    pytest.importorskip("choreographer", reason="without the driver of browsers that is what is said of both")
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(InputError, match=r"pip install 'drakerock\[film\]'"):
        write_film(cycles[0], tmp_path / f"film{ending}", FilmSettings())


def test_a_missing_browser_is_said(cycles, monkeypatch):
    pytest.importorskip("choreographer", reason="without the driver of browsers that is what is said")
    monkeypatch.setenv("BROWSER_PATH", "/nowhere/chromium")

    async def visit():
        async with open_page(cycles[0] / "replay.html"):
            pass

    with pytest.raises(InputError, match="BROWSER_PATH"):
        asyncio.run(visit())


def test_outcome_texts_are_no_html(tmp_path, plan, session_recording):
    folder = write_cycle(tmp_path / "a<b>", plan, session_recording, {"reason": "stuck </script><b>"})
    page = write_replay(folder).read_text()
    assert "stuck </script>" not in page
    assert json.loads((folder / "outcome.json").read_text())["reason"] == "stuck </script><b>"
