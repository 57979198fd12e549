"""A film of a loading, made from its replay's page without a display."""

from __future__ import annotations

import asyncio
import io
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from drakerock.errors import InputError
from drakerock.files import make_folder
from drakerock.viewing.browser import Page, open_page
from drakerock.viewing.replay import write_replay

CAMERAS = ("side", "driver", "top", "bucket")
_READY_POLLS, _POLL_INTERVAL = 600, 0.1  # a minute in all


@dataclass(frozen=True)
class FilmSettings:
    """How a film is made.

    Attributes:
        fps: pictures per second of the film.
        speed: seconds of the loading per second of the film.
        width, height: of a picture [pixels]; even.
        camera: one of CAMERAS.
        cut: how far the rocks before the machine are left out, from 0 (none) to 1 (up to its middle).
    """

    fps: float = 15.0
    speed: float = 1.0
    width: int = 1280
    height: int = 720
    camera: str = "side"
    cut: float = 0.0


def write_film(
    folder: str | Path,
    path: Path,
    settings: FilmSettings = FilmSettings(),
    progress: Callable[[float], None] | None = None,
) -> None:
    """Write a stored loading as a film.

    Args:
        folder: of the loading.
        path: ends with .mp4 or .gif; without an ending: a folder of frame_0000.png, ...
        settings: how.
        progress: called with the share in [0, 1] that is done.

    Raises:
        InputError: the loading cannot be read, the film cannot be written, an unknown ending, or what is needed is not
            installed: choreographer and Chromium or Chrome, for .mp4 imageio-ffmpeg.
    """
    if path.suffix not in ("", ".mp4", ".gif"):
        raise InputError(f"{path}: .mp4, .gif, or a folder without an ending, for PNG pictures")
    if settings.width % 2 or settings.height % 2:
        raise InputError(f"a film's width and height are even, not {settings.width}x{settings.height}")
    writers: dict[str, Callable[[Path, FilmSettings], Any]] = {"": _Pictures, ".mp4": _Mp4, ".gif": _Gif}
    with tempfile.TemporaryDirectory() as place:
        page = write_replay(folder, Path(place) / "replay.html")
        # ffmpeg starts with its writer: not before the loading has been read.
        writer = writers[path.suffix](path, settings)
        try:
            asyncio.run(_film(page, writer, settings, progress or (lambda _share: None)))
        except OSError as error:
            raise InputError(f"{path}: cannot be written: {error.strerror or error}") from None
        finally:
            writer.close()


async def _film(path: Path, writer: Any, settings: FilmSettings, tell: Callable[[float], None]) -> None:
    async with open_page(path, settings.width, settings.height) as page:
        await wait_until_ready(page)
        await page.evaluate(
            "replay.setPlaying(false); document.body.classList.add('film'); "
            f"replay.setCamera({settings.camera!r}); for (const s of replay.scenes) s.setCut({settings.cut})"
        )
        times = list(_list_times(await page.evaluate("replay.duration"), settings))
        for number, time in enumerate(times):
            await page.evaluate(
                f"replay.seek({time}); replay.render(); new Promise(r => requestAnimationFrame(() => r()))"
            )
            writer.add(await page.take_picture())
            tell((number + 1) / len(times))


async def wait_until_ready(page: Page) -> None:
    """Wait until a replay's page has drawn its first picture.

    Raises:
        RuntimeError: it has not after a minute.
    """
    for _ in range(_READY_POLLS):
        if await page.evaluate("Boolean(window.replay && window.replay.first)"):
            return
        await asyncio.sleep(_POLL_INTERVAL)
    raise RuntimeError("the page draws nothing: " + "; ".join(page.faults))


def _list_times(duration: float, settings: FilmSettings) -> Iterator[float]:
    """Return the loading's time at each picture [s], the end among them."""
    step = settings.speed / settings.fps
    yield from (min(k * step, duration) for k in range(int(np.ceil(duration / step)) + 1))


class _Pictures:
    """A folder of PNG files."""

    def __init__(self, path: Path, settings: FilmSettings) -> None:
        make_folder(path)
        self._path, self._count = path, 0

    def add(self, picture: bytes) -> None:
        (self._path / f"frame_{self._count:04d}.png").write_bytes(picture)
        self._count += 1

    def close(self) -> None:
        pass


class _Gif:
    """An animated GIF; each picture has its own palette."""

    def __init__(self, path: Path, settings: FilmSettings) -> None:
        make_folder(path.parent)
        self._path, self._duration = path, 1000.0 / settings.fps
        self._pictures: list[Image.Image] = []

    def add(self, picture: bytes) -> None:
        image = Image.open(io.BytesIO(picture)).convert("RGB")
        self._pictures.append(image.quantize(128, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE))

    def close(self) -> None:
        if self._pictures:
            first, *rest = self._pictures
            first.save(self._path, save_all=True, append_images=rest, duration=self._duration, loop=0)


class _Mp4:
    """H.264 in MP4, by ffmpeg."""

    def __init__(self, path: Path, settings: FilmSettings) -> None:
        try:
            import imageio_ffmpeg
        except ImportError:
            raise InputError(
                "an .mp4 needs the package imageio-ffmpeg: pip install 'drakerock[film]'; a .gif or PNGs do not"
            ) from None
        make_folder(path.parent)
        self._frames = imageio_ffmpeg.write_frames(
            str(path), (settings.width, settings.height), fps=settings.fps, macro_block_size=2, quality=7,
        )  # fmt: skip
        self._frames.send(None)

    def add(self, picture: bytes) -> None:
        self._frames.send(np.asarray(Image.open(io.BytesIO(picture)).convert("RGB")).tobytes())

    def close(self) -> None:
        self._frames.close()
