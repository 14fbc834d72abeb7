"""Videos: files of pictures, which appear when they are complete. They need the extra
`video`."""

import os
from collections.abc import Iterable

from v3dg import _extras, _files
from v3dg._numbers import check
from v3dg.gaussians import Array
from v3dg.pictures import to_8bit


def write_video(
    path: str | os.PathLike[str], pictures: Iterable[Array], *, fps: int = 30, quality: int = 18
) -> int:
    """Encode pictures one after another as H.264 in an .mp4 file, which appears when it
    is complete.

    Args:
        pictures: (H, W, 3) floats in [0, 1], NumPy arrays or torch tensors, all of one
            size; height and width are even.
        fps: Pictures a second.
        quality: Constant rate factor, 0 to 51; smaller is better and larger, 18 shows
            no difference.

    Returns:
        Number of pictures in the video.

    Raises:
        ImportError: The extra is not installed.
        ValueError: Another suffix, no pictures, or pictures of an odd or a changing
            size.
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
            check("pictures", pixels.shape == size, f"{size} as before, got {pixels.shape}")
            is_even = len(size) == 3 and size[0] % 2 == 0 and size[1] % 2 == 0
            check("pictures", is_even, f"an even height and width, got {pixels.shape}")
            video.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
            num_pictures += 1
        check("pictures", num_pictures, "at least one, got none")
        video.mux(stream.encode())
    return num_pictures
