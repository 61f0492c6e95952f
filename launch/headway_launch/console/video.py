"""Frames of an episode with a caption, and their files."""

import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts.errors import HeadwayError
from headway_launch.console.output_files import write_error
from headway_launch.console.progress_display import CountedProgress

if TYPE_CHECKING:
    from PIL import Image

Frame = NDArray[np.uint8]
"""(height, width, 3), RGB."""

_SIZE, _LINE, _EDGE = 13, 18, 5
"""Font size, line height and margin, pixels."""


def caption_strip(caption: str, width: int) -> Frame:
    """Return the caption as a picture `width` pixels wide, in as many lines as it needs."""
    from PIL import Image, ImageDraw, ImageFont

    font, letters = ImageFont.load_default(_SIZE), len(caption)
    lines = wrap(caption, letters)
    while letters > 1 and max(map(font.getlength, lines)) > width - 2 * _EDGE:
        letters -= 1
        lines = wrap(caption, letters)
    strip = Image.new("RGB", (width, 2 * _EDGE + _LINE * len(lines)), "#ffffff")
    pen = ImageDraw.Draw(strip)
    for place, line in enumerate(lines):
        pen.text((_EDGE, _EDGE + _LINE * place), line, "#20242a", font)
    return np.asarray(strip, np.uint8)


@dataclass(frozen=True)
class PackedFrame:
    """A compressed frame; an episode may have thousands of frames of one megabyte each."""

    content: bytes
    shape: tuple[int, ...]

    @classmethod
    def of(cls, frame: Frame) -> "PackedFrame":
        """Compress a frame."""
        return cls(zlib.compress(frame.tobytes(), 1), frame.shape)

    def unpacked(self) -> Frame:
        """Return the original frame."""
        return np.frombuffer(zlib.decompress(self.content), np.uint8).reshape(self.shape)


@contextmanager
def _writing(output: Path) -> Iterator[None]:
    """Create the file's folder if needed. Raises HeadwayError if the file cannot be written."""
    try:
        output.parent.mkdir(exist_ok=True)
        yield
    except OSError as error:
        raise write_error("--output", output, error) from error


def write_picture(frame: Frame, output: Path, caption: str) -> None:
    """Write a frame as PNG, with the caption as its title. Raises HeadwayError if it cannot be written."""
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    words = PngInfo()
    words.add_text("Title", caption)
    with _writing(output):
        Image.fromarray(frame).save(output, pnginfo=words)


def write_film(frames: Sequence[PackedFrame], output: Path, fps: float, caption: str) -> None:
    """Write frames as a GIF, `fps` per second, with the caption as its comment.

    Raises HeadwayError if it cannot be written.
    """
    from PIL import Image

    palette = _palette(frames)
    pause = [round(1000.0 / fps)] * (len(frames) - 1) + [2000]
    with _writing(output), CountedProgress("frames written", len(frames)) as written:

        def picture_of(frame: PackedFrame) -> Image.Image:
            written.add()
            whole = Image.fromarray(frame.unpacked())
            return whole.quantize(palette=palette, dither=Image.Dither.NONE)

        pictures = map(picture_of, frames)
        next(pictures).save(
            output, save_all=True, append_images=pictures, duration=pause, loop=0, comment=caption.encode()
        )


def mp4_writer() -> Any:  # noqa: ANN401 - a module
    """Return imageio-ffmpeg, which an extra installs. Raises HeadwayError if it is missing."""
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise HeadwayError(
            "--output: an .mp4 needs the package imageio-ffmpeg; install it with "
            'pip install "headway[video]", or write a .gif'
        ) from error
    return imageio_ffmpeg


def write_mp4(frames: Sequence[PackedFrame], output: Path, fps: float, caption: str) -> None:
    """Write frames as an H.264 video, `fps` per second, with the caption as its title.

    Raises HeadwayError if it cannot be written.
    """
    height, width = (side // 2 * 2 for side in frames[0].shape[:2])  # the pixel format halves both
    video = mp4_writer().write_frames(
        str(output),
        (width, height),
        fps=fps,
        macro_block_size=2,
        ffmpeg_log_level="error",
        output_params=["-metadata", f"title={caption}"],
    )
    with _writing(output), CountedProgress("frames written", len(frames)) as written:
        video.send(None)
        for frame in frames:
            video.send(np.ascontiguousarray(frame.unpacked()[:height, :width]))
            written.add()
        video.close()


def _palette(frames: Sequence[PackedFrame]) -> "Image.Image":
    """Return one palette for all frames, so that unchanged pixels are stored once; it keeps rare colours."""
    from PIL import Image

    some = [frame.unpacked() for frame in (*frames[:: max(len(frames) // 8, 1)], frames[-1])]
    return Image.fromarray(np.concatenate(some)).quantize(256, Image.Quantize.MAXCOVERAGE)
