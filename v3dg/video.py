"""Writes videos as H.264 in .mp4 files. Needs the extra `video`."""

import os
from collections.abc import Iterable

from v3dg import _extras, _files
from v3dg._numbers import check
from v3dg.gaussians import Array
from v3dg.pictures import to_8bit


def write_video(
    path: str | os.PathLike[str], pictures: Iterable[Array], *, fps: int = 30, quality: int = 18
) -> int:
    """Encode a sequence of pictures as H.264 in an .mp4 file. The file appears only
    when it is complete.

    Args:
        pictures: (H, W, 3) floats in [0, 1], as NumPy arrays or torch tensors. All must
            have the same size, with even height and width.
        fps: Pictures per second.
        quality: Constant rate factor, 0 to 51. Smaller values give better pictures and
            larger files. At 18, no difference is visible.

    Returns:
        Number of pictures in the video.

    Raises:
        ImportError: The extra `video` is not installed.
        ValueError: The suffix is not .mp4, there are no pictures, or a picture has an
            odd size or another size than the first one.
    """
    av = _extras.load("av")
    check(path, os.fspath(path).endswith(".mp4"), "a file name ending in .mp4")
    num_pictures = 0
    size: tuple[int, ...] | None = None
    with _files.replacing(path) as temporary, av.open(temporary, "w", format="mp4") as video:
        stream = video.add_stream("h264", rate=fps, options={"crf": str(quality)})
        stream.pix_fmt = "yuv420p"
        for picture in pictures:
            pixels = to_8bit(picture)
            if size is None:
                size = pixels.shape
                stream.height, stream.width = size[:2]
            check(
                "pictures",
                pixels.shape == size,
                f"the shape {size} of the first picture, got {pixels.shape}",
            )
            is_even = len(size) == 3 and size[0] % 2 == 0 and size[1] % 2 == 0
            check("pictures", is_even, f"an even height and width, got {pixels.shape}")
            video.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
            num_pictures += 1
        check("pictures", num_pictures, "at least one picture, got none")
        video.mux(stream.encode())
    return num_pictures
