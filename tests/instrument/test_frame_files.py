"""Frames come out of every kind of file as they went in, and bad files are one sentence in bounded memory."""

import io
import struct
import tracemalloc
import zipfile
import zlib

import h5py
import numpy as np
import pytest
from PIL import Image

from greenough.instrument.errors import InputError
from greenough.instrument.frame_files import MAX_BYTES, read_frames


@pytest.fixture(params=[np.uint8, np.uint16])
def stack(request):
    return np.random.default_rng(1).integers(0, np.iinfo(request.param).max, (12, 6, 9), request.param)


def write_images(folder, stack, suffix=".png"):
    folder.mkdir(exist_ok=True)
    paths = [folder / f"frame{number}{suffix}" for number in range(len(stack))]
    for path, image in zip(paths, stack, strict=True):
        Image.fromarray(image).save(path)
    return paths


def test_every_kind_of_file_gives_the_same_frames(tmp_path, stack):
    np.save(tmp_path / "stack.npy", stack)
    np.savez(tmp_path / "plain.npz", stack)
    np.savez_compressed(tmp_path / "two.npz", frames=stack, other=stack[:1])
    with h5py.File(tmp_path / "stack.h5", "w") as file:
        file["frames"], file["other"] = stack, np.zeros(3)
    pages = [Image.fromarray(image) for image in stack]
    pages[0].save(tmp_path / "pages.tiff", save_all=True, append_images=pages[1:])
    images = write_images(tmp_path / "folder", stack)
    write_images(tmp_path / "tiffs", stack, ".tif")
    for names in (
        ["stack.npy"],
        ["plain.npz"],
        ["two.npz:frames"],
        ["stack.h5"],
        ["stack.h5:frames"],
        ["pages.tiff"],
        ["folder"],
        ["tiffs"],
        ["folder/frame?.png", "folder/frame1?.png"],
        ["folder/*.png"],
        [f"folder/{path.name}" for path in images],
    ):
        files = read_frames([str(tmp_path / name) for name in names])
        assert files.stack.dtype == stack.dtype
        np.testing.assert_array_equal(files.stack, stack, err_msg=str(names))
        assert len(files.names) == len(stack)


def test_colours_that_are_grey_are_grey_and_others_are_refused(tmp_path):
    grey = np.random.default_rng(2).integers(0, 255, (5, 7), np.uint8)
    Image.fromarray(np.stack([grey] * 3, axis=-1)).save(tmp_path / "grey.png")
    np.testing.assert_array_equal(read_frames([str(tmp_path / "grey.png")]).stack[0], grey)
    Image.fromarray(np.stack([grey, grey, 255 - grey], axis=-1)).save(tmp_path / "red.png")
    with pytest.raises(InputError, match="3 channels that differ"):
        read_frames([str(tmp_path / "red.png")])


def npy_header(shape, dtype="|u1"):
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": dtype, "fortran_order": False, "shape": shape})
    return stream.getvalue()


def huge_png():
    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", 60_000, 60_000, 8, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(bytes(1000))) + chunk(b"IEND", b"")
    )


@pytest.mark.slow
def test_bad_files_are_one_sentence_and_cost_no_memory(tmp_path, stack):
    (path, *_) = write_images(tmp_path / "folder", stack)
    whole = path.read_bytes()
    (tmp_path / "cut.png").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "text.png").write_text("<script>alert(1)</script>")
    (tmp_path / "empty.png").touch()
    (tmp_path / "huge.png").write_bytes(huge_png())
    (tmp_path / "cut.npy").write_bytes(b"\x93NUMPY\x01\x00")
    (tmp_path / "claims.npy").write_bytes(npy_header((20, 32_768, 32_768)))
    (tmp_path / "short.npy").write_bytes(npy_header((24, 960, 1280)) + bytes(1000))
    (tmp_path / "negative.npy").write_bytes(npy_header((-24, 960, 1280)) + bytes(1000))
    np.save(tmp_path / "object.npy", np.array([{}], dtype=object), allow_pickle=True)
    (tmp_path / "text.npz").write_text("not a zip file")
    with (
        zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("a.npy", "w", force_zip64=True) as entry,
    ):
        entry.write(npy_header((5, 2**30)))
        for _ in range(5 * 64):
            entry.write(bytes(2**24))
    np.savez_compressed(tmp_path / "spoiled.npz", stack)
    spoiled = bytearray((tmp_path / "spoiled.npz").read_bytes())
    spoiled[60:90] = bytes(255 - value for value in spoiled[60:90])
    (tmp_path / "spoiled.npz").write_bytes(spoiled)
    with zipfile.ZipFile(tmp_path / "claims.npz", "w") as archive:
        archive.writestr("a.npy", npy_header((3, 2**15, 2**15)) + bytes(100))
    with h5py.File(tmp_path / "claims.h5", "w") as file:
        file.create_dataset("frames", (20, 32_768, 32_768), np.uint8, chunks=(1, 1024, 1024))
    (tmp_path / "text.h5").write_text("not HDF5")
    (tmp_path / "nothing").mkdir()
    (tmp_path / "small.png").write_bytes(b"")
    Image.fromarray(stack[0, :3]).save(tmp_path / "small.png")
    sentences = {
        "cut.png": "damaged",
        "text.png": "not an image",
        "empty.png": "not an image",
        "huge.png": "claims",
        "cut.npy": "not a whole .npy",
        "claims.npy": "claims 20 GiB",
        "short.npy": "not a whole .npy",
        "negative.npy": "not a whole .npy",
        "object.npy": "not a whole .npy",
        "text.npz": "not a whole .npz",
        "spoiled.npz": "not a whole .npz",
        "bomb.npz": "claims 5 GiB",
        "claims.npz": "not a whole .npz",
        "claims.h5": "claims 20 GiB",
        "text.h5": "not HDF5",
        "nothing": "holds no image",
        "absent.png": "no file",
        "absent.npy": "no file",
        "absent*.png": "no file matches",
        "claims.h5:other": "no dataset other",
    }
    tracemalloc.start()
    try:
        for name, says in sentences.items():
            with pytest.raises(InputError, match=says) as raised:
                read_frames([str(tmp_path / name)])
            assert "\n" not in str(raised.value)
        with pytest.raises(InputError, match="must be alike"):
            read_frames([str(path), str(tmp_path / "small.png")])
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 50e6 < MAX_BYTES
