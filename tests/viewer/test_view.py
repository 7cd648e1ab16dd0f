"""`unbake view` shows data sets and runs, follows a running fit, and leaves everything as it is."""

import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
import urllib.request
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest
from support import BROWSERS, found_browser, tiny_fields

from unbake import cli
from unbake.config import to_toml
from unbake.errors import UserError
from unbake.exports.parts import read_parts
from unbake.imaging.pictures import MAGMA, OUTSIDE_MASK, write_png
from unbake.io import write_text
from unbake.training.checkpoint import Progress, save_checkpoint
from unbake.training.recovered import open_run
from unbake.training.run_folder import RunFolder
from unbake.viewer import viewed as viewed_module
from unbake.viewer.dependencies import require_viser
from unbake.viewer.glb import before_tone_mapping
from unbake.viewer.surface import make_surface
from unbake.viewer.view import Viewer, opened
from unbake.viewer.viewed import RADIANCE, SHAPE, ViewedData, ViewedRun, log_tail

EYE = np.array([0.0, 0.0, 5.0])


@pytest.fixture
def run(repository, tmp_path) -> Path:
    """A run of version 0.1 beside its data set, both to be changed."""
    shutil.copytree(repository / "tests" / "data" / "version-0.1", tmp_path / "both")
    return tmp_path / "both" / "run"


def digest(folder):
    """All files of a folder, with their content and times."""
    return {
        path.relative_to(folder).as_posix(): (
            path.stat().st_mtime_ns,
            hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else None,
        )
        for path in sorted(folder.rglob("*"))
    }


def fit_on(run, step):
    """Write a checkpoint of other fields, as a running fit does."""
    fit = open_run(run)
    for _, optimizer in fit.state.optimizers():
        for key in list(optimizer.keys()):
            noise = np.random.default_rng(step).normal(0, 0.5, optimizer[key].shape)
            optimizer[key] = type(optimizer[key])(noise.astype(np.float32))
    return save_checkpoint(RunFolder(run), fit.state, Progress(step=step, seconds=9.0))


# --------------------------------------------------------------------------------- what is shown


def test_surfaces_are_divided_without_a_gap(cornell):
    parts = read_parts(cornell / "scene" / "scene.xml", cornell).parts
    surface = make_surface(parts, vertices=4000)
    assert 2000 < len(surface.positions) < 12000
    a, b, c = np.moveaxis(surface.positions[surface.faces].astype(np.float64), 1, 0)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    whole = sum(part.triangles.areas().sum() for part in parts)
    np.testing.assert_allclose(areas.sum(), whole, rtol=1e-5)
    # Normals lie on the side from which the corners of triangles run counterclockwise.
    assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), surface.normals[surface.faces[:, 0]]) > 0
            ).all()  # fmt: skip


def test_tone_mapping_gives_back_the_colours():
    colours = np.random.default_rng(0).integers(0, 256, (500, 3)).astype(np.uint8)
    colours[:2] = [[0, 0, 0], [255, 255, 255]]
    before = np.array([[0.59719, 0.35458, 0.04823], [0.076, 0.90834, 0.01566],
                       [0.0284, 0.13383, 0.83777]])  # fmt: skip
    after = np.array([[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605],
                      [-0.00327, -0.07276, 1.07602]])  # fmt: skip
    v = before_tone_mapping(colours).astype(np.float64) / 0.6 @ before.T
    v = (v * (v + 0.0245786) - 0.000090537) / (v * (0.983729 * v + 0.432951) + 0.238081)
    v = np.clip(v @ after.T, 0, 1)
    found = 255 * np.where(v <= 0.0031308, 12.92 * v, 1.055 * v ** (1 / 2.4) - 0.055)
    assert np.abs(found - colours).max() < 0.6


def test_a_data_set_shows_its_true_materials_and_photographs(cornell):
    before = digest(cornell)
    viewed = ViewedData(cornell)
    assert list(viewed.choices()) == [SHAPE, "albedo", "roughness", "metallic"]
    colours = viewed.colours("albedo", EYE).astype(int)
    assert colours.shape == viewed.surface.positions.shape
    assert (colours[:, 0] - colours[:, 1]).max() > 50  # a red wall
    assert (colours[:, 1] - colours[:, 0]).max() > 50  # and a green one
    ((photograph, truth),) = viewed.pictures(viewed.dataset.train[0], "albedo")
    assert photograph.pixels.shape == truth.pixels.shape == (16, 16, 3)
    assert photograph.pixels.std() > 5
    assert digest(cornell) == before


def test_photographs_of_a_data_set_are_made_small(cornell, monkeypatch):
    monkeypatch.setattr(viewed_module, "LONGEST", 8)
    viewed = ViewedData(cornell)
    ((photograph, truth),) = viewed.pictures(viewed.dataset.train[0], "albedo")
    assert photograph.pixels.shape == truth.pixels.shape == (8, 8, 3)


def test_surfaces_that_nobody_sees_are_not_shown(cornell, tmp_path):
    shutil.copytree(cornell, tmp_path / "data")
    file = tmp_path / "data" / "scene" / "scene.xml"
    box = '<shape type="cube" id="helper"><bsdf type="null"/></shape></scene>'
    file.write_text(file.read_text().replace("</scene>", box))
    shown = ViewedData(tmp_path / "data").surface
    assert len(shown.positions) == len(ViewedData(cornell).surface.positions)


def test_a_run_shows_what_was_recovered_and_its_error(run):
    viewed = ViewedRun(run)
    assert viewed.told()["checkpoint"] == "none yet" and viewed.follow() and not viewed.follow()
    names = ["albedo", "roughness"]
    assert [*viewed.choices()] == [*names, RADIANCE, *(f"{n} error" for n in names), SHAPE]
    shown = {choice: viewed.colours(choice, EYE) for choice in viewed.choices()}
    assert len({colours.tobytes() for colours in shown.values()}) == len(shown)
    elsewhere = viewed.colours(RADIANCE, -EYE)
    assert (elsewhere != shown[RADIANCE]).any()
    first, second = viewed.pictures(viewed.dataset.heldout[0], "albedo")
    assert [p.caption for p in first] == ["photograph", "one bounce", "error, 0 to 0.25"]
    assert [p.caption for p in second] == ["true albedo", "recovered albedo", "error, 0 to 0.25"]
    photograph, rendering = (p.pixels.astype(float) for p in first[:2])
    assert np.corrcoef(photograph.ravel(), rendering.ravel())[0, 1] > 0.8
    assert viewed.log()["step"] == "60"


def test_errors_of_clipped_photographs_are_of_what_they_can_show(run):
    file = run.parent / "data" / "transforms.json"
    transforms = json.loads(file.read_text())
    for frame in transforms["frames"]:
        frame["clipped"] = 1e-4  # nearly all of it is brighter
    file.write_text(json.dumps(transforms))
    viewed = ViewedRun(run)
    assert viewed.follow()
    (photograph, _, error), _ = viewed.pictures(viewed.dataset.heldout[0], "albedo")
    assert photograph.pixels.mean() > 5
    np.testing.assert_array_equal(error.pixels, np.broadcast_to(MAGMA[0], error.pixels.shape))


def test_errors_are_grey_where_a_mask_says_that_pixels_do_not_count(run):
    data = run.parent / "data"
    transforms = json.loads((data / "transforms.json").read_text())
    height, width = (transforms["frames"][0].get(k, transforms.get(k)) for k in "hw")
    mask = np.full((height, width), 255, np.uint8)
    mask[: height // 2] = 0
    write_png(data / "mask.png", mask)
    for frame in transforms["frames"]:
        frame["mask_path"] = "mask.png"
    (data / "transforms.json").write_text(json.dumps(transforms))
    viewed = ViewedRun(run)
    assert viewed.follow()
    for row in viewed.pictures(viewed.dataset.heldout[0], "albedo"):
        grey = (row[-1].pixels == OUTSIDE_MASK).all(-1)
        assert grey[: height // 2].all() and not grey[height // 2 :].all()


def test_the_end_of_a_log_is_told():
    line = {"step": 5, "seconds": 2.0, "samples_per_second": 1000.0, "lhs": 0.25}
    score = {"step": 5, "seconds": 2.0, "validation": {"split": "heldout", "albedo_psnr": 20.0}}
    told = log_tail([line | {"skipped": 2}, line | {"skipped": 3}, line | {"lhs": 0.125}, score])
    assert told == {
        "step": "5", "seconds": "2", "samples / s": "1,000", "skipped steps": "5",
        "loss: lhs": "0.1250", "validation: albedo": "20.00 dB",
    }  # fmt: skip
    assert log_tail([]) == {}


def test_a_checkpoint_that_is_not_whole_is_read_again_later(run):
    viewed = ViewedRun(run)
    assert viewed.follow() and viewed.progress.step == 60
    before = viewed.colours("albedo", EYE)
    state = next(fit_on(run, 90).glob("*.safetensors"))
    content = state.read_bytes()
    state.write_bytes(content[: len(content) // 2])
    assert not viewed.follow() and viewed.progress.step == 60
    state.write_bytes(content)
    assert viewed.follow() and viewed.progress.step == 90
    assert (viewed.colours("albedo", EYE) != before).any()
    shutil.rmtree(run / "checkpoints")
    assert not viewed.follow() and viewed.progress.step == 90


# --------------------------------------------------------------------------------------- the page


@pytest.fixture
def viewer(run):
    """A page that shows the run."""
    with Viewer(opened(run), 0) as viewer:
        viewer.step(0)
        yield viewer


def test_the_page_is_served_to_this_machine_alone(viewer):
    with urllib.request.urlopen(viewer.url, timeout=20) as answer:
        assert b"<html" in answer.read(2000).lower()
    listening = [c for c in psutil.Process().net_connections() if c.status == psutil.CONN_LISTEN]
    port = int(viewer.url.rpartition(":")[2])
    assert [c.laddr.ip for c in listening if c.laddr.port == port] == ["127.0.0.1"]
    assert {c.laddr.ip for c in listening} == {"127.0.0.1"}
    with pytest.raises(UserError, match=f"port {port} is taken.*--port 0"):
        Viewer(viewer._viewed, port)
    with pytest.raises(UserError, match="--port: must be a number from 0"):
        Viewer(viewer._viewed, 70000)


def test_web_sites_in_the_same_browser_are_refused(viewer):
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    address = viewer.url.replace("http", "ws")
    version = {"subprotocols": ["viser-v1"]}
    with pytest.raises(InvalidStatus):
        connect(address, origin="https://example.org", **version)
    with connect(address, origin=viewer.url, **version):
        pass
    assert viewer._page._server.request_share_url() is None


def test_the_page_follows_a_run_and_changes_nothing_in_it(viewer, run):
    page = viewer._page
    first = page._surface.glb_data
    assert "step 60" in page._facts.content and "data:image/png" in page._pictures.content
    fit_on(run, 90)
    before = digest(run)
    viewer._looked = -100.0
    viewer.step(0)
    assert "step 90" in page._facts.content and page._surface.glb_data != first
    # Where the page moves the slider, nobody asks for that checkpoint
    page.show_checkpoints(3, 1, "")
    assert page._checkpoints.value == 1 and page.events.empty()
    page._tell("checkpoint", 1)
    viewer.step(0)
    viewer.step(0)
    assert "step 60" in page._facts.content and page._surface.glb_data == first
    pictures = page._pictures.content
    page._tell("step", 1)
    page._tell("choice", "Roughness")
    viewer.step(0)
    viewer.step(0)
    assert page._pictures.content != pictures and page._surface.glb_data != first
    page.close()
    assert digest(run) == before


def test_clicks_that_come_quickly_end_at_the_last_one(viewer):
    page, count = viewer._page, len(viewer._views)
    for _ in range(2):
        page._tell("step", 1)
    viewer.step(0)
    assert viewer._number == 2 % count and page._chosen == viewer._number
    # What the page changed itself is no click
    assert page.events.empty()
    for value in page._views.options:  # such as a visitor's
        page._views.value = value
    assert page.events.empty()


def test_what_is_wrong_with_a_checkpoint_stays_on_the_page(viewer, run, monkeypatch):
    def fails(self):
        raise UserError("the checkpoint is of a newer version")

    page = viewer._page
    with monkeypatch.context() as patch:
        patch.setattr(ViewedRun, "follow", fails)
        viewer._looked = -100.0
        viewer.step(0)
        assert "newer version" in page._note.content
        page._tell("choice", "Roughness")
        viewer.step(0)
        viewer.step(0)
        assert "newer version" in page._note.content, "pictures are no answer to it"
    viewer._looked = -100.0
    viewer.step(0)
    assert "newer version" not in page._note.content


#: A fit of one thread, so that sums have one order, which takes long enough to be watched.
ONE_THREAD = """
import time
from unbake import backend, cli
backend.activate()
import drjit as dr
from unbake.training.step import TrainingStep
plain = TrainingStep.__call__
def step(self, state, number, rates):
    dr.set_thread_count(1)
    try:
        time.sleep(0.2)
        return plain(self, state, number, rates)
    finally:
        dr.sync_thread()
        dr.set_thread_count(2)
TrainingStep.__call__ = step
cli.main()
"""


@pytest.mark.slow
def test_a_fit_that_is_watched_ends_as_one_that_is_not(cornell, tmp_path):
    """Two checkpoints are followed while it runs; the last state is the same bit by bit."""
    fields = replace(tiny_fields("grid"), method="direct", steps=60, checkpoint_seconds=0.5)
    write_text(tmp_path / "settings.toml", to_toml(fields))
    words = ["fit", cornell, "--settings", tmp_path / "settings.toml"]

    def begun(out):
        command = [sys.executable, "-c", ONE_THREAD, *words, "--out", out]
        source = os.environ | {"PYTHONPATH": str(Path(cli.__file__).parents[2])}
        return subprocess.Popen(
            list(map(str, command)), env=source, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip

    watched, alone = tmp_path / "watched", tmp_path / "alone"
    fit, seen, until = begun(watched), set(), time.monotonic() + 240
    try:
        while time.monotonic() < until and not list((watched / "checkpoints").glob("step-*")):
            assert fit.poll() is None, fit.communicate()[0]
            time.sleep(0.05)
        with Viewer(opened(watched), 0) as viewer:
            while fit.poll() is None and time.monotonic() < until:
                viewer._looked = -100.0
                viewer.step(0.01)
                seen.add(viewer._viewed.shown)
            viewer._looked = -100.0
            viewer.step(0)
            seen.add(viewer._viewed.shown)
        told = fit.communicate(timeout=60)[0]
        assert fit.returncode in (0, 1), told
    finally:
        fit.kill()
    assert len(seen - {None}) >= 2, told
    other = begun(alone)
    told = other.communicate(timeout=120)[0]
    assert other.returncode == fit.returncode, told
    last = [max(run.glob("checkpoints/step-*")) for run in (watched, alone)]
    assert last[0].name == last[1].name
    last = [folder / "state.safetensors" for folder in last]
    assert last[0].read_bytes() == last[1].read_bytes()


def test_names_are_text_on_the_page(viewer):
    name = "<img src=x onerror=alert(1)>{alert(1)}"
    viewer._page.show_facts({name: name})
    viewer._page.show_log({name: name})
    viewer._page.say(name)
    for part in (viewer._page._facts, viewer._page._log, viewer._page._note):
        assert "<img" not in part.content and "&lt;img" in part.content


def test_what_cannot_be_shown_has_a_remedy(tmp_path, monkeypatch):
    with pytest.raises(UserError, match=r"no such folder"):
        opened(tmp_path / "none")
    with pytest.raises(UserError, match=r"neither a run nor a data set.*unbake fit"):
        opened(tmp_path)
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(UserError, match=r"needs viser. pip install 'unbake\[view\]'"):
        require_viser()


def test_a_signal_ends_the_command(cornell):
    words = [sys.executable, "-m", "unbake", "view", cornell, "--port", "0"]
    source = str(Path(cli.__file__).parents[2])
    process = subprocess.Popen(
        words, env=os.environ | {"PYTHONPATH": source}, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip
    assert re.match(r"http://127\.0\.0\.1:\d+ shows ", process.stdout.readline())
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert (process.returncode, out, err) == (130, "", "")


# ------------------------------------------------------------------------------------ in a browser


def complaints(browser, url, profile, loaded):
    """Errors in the console of a browser that opens a page, until seconds after it has loaded."""
    from websockets.sync.client import connect

    flags = ["--headless", "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-sync",
             "--disable-background-networking", "--disable-component-update", "--use-gl=angle",
             "--use-angle=swiftshader", "--enable-unsafe-swiftshader", f"--user-data-dir={profile}",
             "--remote-debugging-port=0", "about:blank"]  # fmt: skip
    process = subprocess.Popen([browser, *flags], stderr=subprocess.PIPE, text=True)
    reader = threading.Thread(target=process.stderr.read)
    try:
        lines = (re.search(r"listening on (ws://[^/]+)", line) for line in process.stderr)
        root = next(filter(None, lines))[1]
        reader.start()
        with urllib.request.urlopen(f"{root.replace('ws', 'http')}/json", timeout=20) as answer:
            tab = next(t for t in json.load(answer) if t["type"] == "page")
        with connect(tab["webSocketDebuggerUrl"], max_size=1 << 28) as debugger:
            methods = ("Runtime.enable", "Log.enable", "Network.enable", "Page.navigate")
            for number, method in enumerate(methods):
                params = {"url": url} if method == "Page.navigate" else {}
                debugger.send(json.dumps({"id": number, "method": method, "params": params}))
            end = None
            while end is None or time.monotonic() < end:
                if end is None and loaded.is_set():
                    end = time.monotonic() + 4
                try:
                    event = json.loads(debugger.recv(timeout=0.5))
                except TimeoutError:
                    continue
                params = event.get("params", {})
                method = event.get("method")
                console = method == "Runtime.consoleAPICalled" and params["type"] == "error"
                logged = method == "Log.entryAdded" and params["entry"]["level"] == "error"
                if console or logged or method == "Runtime.exceptionThrown":
                    yield json.dumps(event)[:500]
                if method == "Network.requestWillBeSent":
                    asked = params["request"]["url"]
                    if not asked.startswith((url, f"blob:{url}", "data:")):
                        yield f"asks for {asked[:200]}"
    finally:
        process.terminate()
        process.wait(30)
        reader.join(30)
        process.stderr.close()


def test_a_browser_shows_the_page_without_an_error(viewer, tmp_path):
    browser = found_browser()
    if browser is None:
        pytest.skip(f"none of the browsers {', '.join(BROWSERS)} is installed")
    found, loaded, server = [], threading.Event(), viewer._page._server
    words = (browser, viewer.url, tmp_path / "profile", loaded)
    look = threading.Thread(target=lambda: found.extend(complaints(*words)))
    look.start()
    end = time.monotonic() + 120
    while look.is_alive():
        viewer.step(0.2)
        if server.get_clients() or time.monotonic() > end:
            loaded.set()
    assert time.monotonic() < end and found == []
