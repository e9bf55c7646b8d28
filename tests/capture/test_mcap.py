"""Frame files: lossless, readable by the official reader, and by ours when cut anywhere."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import NonSeekingReader, SeekingReader
from mcap.stream_reader import CRCValidationError

from capture import mcap_records
from capture.errors import TakeError
from capture.frame_header import HEADER_BYTES, FrameHeader, ImageLayout
from capture.mcap import FrameReader, FrameWriter
from tests.capture.refusals import refusal

LAYOUTS = [
    ImageLayout(7, 5, 1, "uint8"),
    ImageLayout(7, 5, 3, "uint8"),
    ImageLayout(4, 6, 1, "uint16"),
    ImageLayout(3, 2, 3, "uint16"),
]


def images(layout: ImageLayout, count: int = 4, seed: int = 0) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    top = np.iinfo(layout.dtype).max
    return [
        rng.integers(0, top, layout.shape, dtype=layout.dtype, endpoint=True) for _ in range(count)
    ]


def write(path: Path, layout: ImageLayout, frames: list[np.ndarray]) -> None:
    with FrameWriter(path, "cam07", layout) as writer:
        for k, image in enumerate(frames):
            header = FrameHeader(k, 7, 65530 + k, 10**12 + k, 2 * 10**12 + 5 * k, 3000.0)
            writer.write(header, image)


@pytest.mark.parametrize("layout", LAYOUTS, ids=str)
def test_frames_come_back_as_they_were_in_any_order(tmp_path: Path, layout: ImageLayout) -> None:
    frames = images(layout)
    write(tmp_path / "a.mcap", layout, frames)
    reader = FrameReader(tmp_path / "a.mcap")
    assert (reader.device, reader.layout, len(reader), reader.closed_well) == (
        "cam07",
        layout,
        4,
        True,
    )
    for k in (3, 0, 2, 1):
        found = reader.read(k)
        assert found.dtype == frames[k].dtype
        assert np.array_equal(found, frames[k])
        assert reader.headers[k].frame_id == 65530 + k
        assert reader.headers[k].t_dev_ns == 10**12 + k
    assert [p.name for p in tmp_path.iterdir()] == ["a.mcap"]


@pytest.mark.parametrize("layout", LAYOUTS, ids=str)
def test_the_official_reader_agrees_crcs_checked(tmp_path: Path, layout: ImageLayout) -> None:
    frames = images(layout)
    write(tmp_path / "a.mcap", layout, frames)
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = SeekingReader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == summary.statistics.chunk_count == 4
        assert len(summary.chunk_indexes) == 4
        for k, (schema, channel, message) in enumerate(reader.iter_messages()):
            assert schema is not None
            assert b"trigger_index" in schema.data
            assert channel.topic == "cam07"
            assert channel.metadata["width"] == str(layout.width)
            assert message.log_time == 2 * 10**12 + 5 * k
            pixels = np.frombuffer(message.data[HEADER_BYTES:], layout.dtype).reshape(layout.shape)
            assert np.array_equal(pixels, frames[k])
        starts = [chunk.message_start_time for chunk in summary.chunk_indexes]
        assert starts == [2 * 10**12 + 5 * k for k in range(4)]
    with (tmp_path / "a.mcap").open("rb") as file:
        assert len(list(NonSeekingReader(file, validate_crcs=True).iter_messages())) == 4


def record_ends(data: bytes) -> list[int]:
    ends, at = [], 8
    while at < len(data) - 8:
        at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")
        ends.append(at)
    return ends


def chunk_ends(data: bytes) -> list[int]:
    ends, at = [], 8
    while at < len(data) - 8:
        kind = data[at]
        at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")
        if kind == 6:
            ends.append(at)
    return ends


def test_a_file_cut_at_any_record_boundary_or_beside_it_is_read_to_its_last_whole_frame(
    tmp_path: Path,
) -> None:
    layout = LAYOUTS[0]
    frames = images(layout)
    write(tmp_path / "whole.mcap", layout, frames)
    data = (tmp_path / "whole.mcap").read_bytes()
    head = record_ends(data)[2]  # header, schema, channel
    chunks = chunk_ends(data)
    cut = tmp_path / "cut.mcap"
    for end in sorted({e + d for e in record_ends(data) for d in (-1, 0, 1)}):
        cut.write_bytes(data[:end])
        if end < head:
            with pytest.raises(TakeError, match=r"cut\.mcap: (cut before|expected an MCAP)"):
                FrameReader(cut)
            continue
        reader = FrameReader(cut)
        assert len(reader) == sum(c <= end for c in chunks)
        assert not reader.closed_well
        for k in range(len(reader)):
            assert np.array_equal(reader.read(k), frames[k])


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_a_flipped_bit_in_a_frame_is_detected(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    path = tmp_path_factory.mktemp("flip") / "a.mcap"
    layout = LAYOUTS[0]
    frames = images(layout, 2)
    write(path, layout, frames)
    whole = bytearray(path.read_bytes())
    end = chunk_ends(bytes(whole))[1]
    size = HEADER_BYTES + layout.nbytes  # the message of the second frame, header and pixels
    place = data.draw(st.integers(end - size, end - 1))
    whole[place] ^= 1 << data.draw(st.integers(0, 7))
    path.write_bytes(bytes(whole))
    if place < end - layout.nbytes and (said := refusal(lambda: FrameReader(path))):
        assert "expected a frame header" in said  # the mark at the header's front
    else:
        reader = FrameReader(path)
        assert np.array_equal(reader.read(0), frames[0])
        with pytest.raises(TakeError, match=r"frame 1 .*damaged: expected CRC"):
            reader.read(1)
    with path.open("rb") as file, pytest.raises(CRCValidationError):
        list(SeekingReader(file, validate_crcs=True).iter_messages())


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_damage_anywhere_is_refused_by_name_or_harmless(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    path = tmp_path_factory.mktemp("damage") / "a.mcap"
    layout = LAYOUTS[2]
    frames = images(layout, 2)
    write(path, layout, frames)
    whole = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(bytes(whole))

    def read_all() -> None:
        reader = FrameReader(path)
        for k in range(len(reader)):
            reader.read(k)

    said = refusal(read_all)
    assert not said or "a.mcap" in said


HEADERS: dict[str, Any] = {
    "trigger_index": st.integers(-(2**63), 2**63 - 1),
    "device_index": st.integers(0, 2**16 - 1),
    "frame_id": st.integers(0, 2**64 - 1),
    "t_dev_ns": st.integers(-(2**63), 2**63 - 1),
    "t_host_ns": st.integers(-(2**63), 2**63 - 1),
    "exposure_us": st.floats(allow_nan=False),
    "status": st.integers(0, 2**32 - 1),
    "pixel_crc": st.integers(0, 2**32 - 1),
}


@given(st.builds(FrameHeader, **HEADERS))
def test_headers_survive_the_round_trip_in_64_bytes(header: FrameHeader) -> None:
    packed = header.pack()
    assert len(packed) == HEADER_BYTES
    assert FrameHeader.unpack(packed) == header


@given(st.binary(max_size=80))
def test_other_bytes_are_no_header(data: bytes) -> None:
    with pytest.raises(TakeError, match="frame header"):
        FrameHeader.unpack(data)


def test_an_interrupted_writer_keeps_its_frames_until_they_are_discarded(tmp_path: Path) -> None:
    layout = LAYOUTS[0]
    frames = images(layout)
    writer = FrameWriter(tmp_path / "a.mcap", "cam07", layout)

    def interrupted() -> None:
        with writer:
            writer.write(FrameHeader(0), frames[0])
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap.partial"]
    assert np.array_equal(FrameReader(tmp_path / "a.mcap.partial").read(0), frames[0])
    writer.discard()
    assert not list(tmp_path.iterdir())


def test_a_file_that_was_never_closed_is_read_from_its_partial(tmp_path: Path) -> None:
    layout = LAYOUTS[0]
    frames = images(layout)
    writer = FrameWriter(tmp_path / "a.mcap", "cam07", layout)
    for k, image in enumerate(frames):
        writer.write(FrameHeader(k), image)
    reader = FrameReader(tmp_path / "a.mcap.partial")  # as after kill -9: nothing is buffered
    assert len(reader) == 4
    assert np.array_equal(reader.read(3), frames[3])
    writer.close()


def test_the_same_frames_give_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.mcap", "b.mcap"):
        write(tmp_path / name, LAYOUTS[1], images(LAYOUTS[1]))
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_no_frame_at_all_is_a_file_too(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap", LAYOUTS[0], [])
    assert len(FrameReader(tmp_path / "a.mcap")) == 0
    with (tmp_path / "a.mcap").open("rb") as file:
        assert list(SeekingReader(file, validate_crcs=True).iter_messages()) == []


def test_pixels_of_another_layout_are_refused(tmp_path: Path) -> None:
    with FrameWriter(tmp_path / "a.mcap", "cam07", LAYOUTS[0]) as writer:
        with pytest.raises(TakeError, match="expected 7 x 5 mono uint8, found 5 x 7 mono uint8"):
            writer.write(FrameHeader(0), np.zeros((7, 5), np.uint8))
        with pytest.raises(TakeError, match="pixel type must be uint8 or uint16, found 'float64'"):
            writer.write(FrameHeader(0), np.zeros((5, 7)))


def test_views_and_big_endian_pixels_are_written_right(tmp_path: Path) -> None:
    whole = images(ImageLayout(8, 12, 1, "uint16"))[0]
    with FrameWriter(tmp_path / "a.mcap", "cam07", ImageLayout(4, 6, 1, "uint16")) as writer:
        writer.write(FrameHeader(0), whole[::2, ::2])
        writer.write(FrameHeader(1), whole[::2, ::2].astype(">u2"))
    reader = FrameReader(tmp_path / "a.mcap")
    assert np.array_equal(reader.read(0), whole[::2, ::2])
    assert np.array_equal(reader.read(1), whole[::2, ::2])


def test_other_files_are_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"not an mcap file at all")
    with pytest.raises(TakeError, match=r"a\.mcap: expected an MCAP file"):
        FrameReader(tmp_path / "a.mcap")
    with pytest.raises(TakeError, match=r"b\.mcap: no such file"):
        FrameReader(tmp_path / "b.mcap")


def test_a_file_that_claims_a_giant_image_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "cam00.mcap"
    claims = {"device": "cam00", "width": "1000000000", "height": "1000000000"}
    claims |= {"channels": "1", "dtype": "uint8"}
    channel = mcap_records.channel_record("cam00", claims)
    path.write_bytes(mcap_records.MAGIC + mcap_records.header_record() + channel)
    with pytest.raises(TakeError, match=r"cam00\.mcap: damaged channel record: 1000000000 x"):
        FrameReader(path)
