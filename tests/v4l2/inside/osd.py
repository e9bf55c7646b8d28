"""Reads the frame number that vivid draws into its pictures: a truth that no counter of ours made.

The first line of the text is the time of the stream and the number; the fifth shows the volume
control, which may be set, so that the shapes of the ten digits are learned from known numbers.
"""

from __future__ import annotations

import time

import numpy as np

from capture.arrays import Image
from capture.devices.v4l2.device import V4l2Device

_CELL_W, _CELL_H = 8, 16
_LEFT, _TOP = 16, 16
_GREY = 100  # between the black of the ground and the white of the text
_NUMBER_AT = 14  # cells before the number: " 00:00:00:164 "
_VOLUME_LINE, _VOLUME_AT = 4, 8
_VOLUMES = (234, 156, 178, 90)  # all ten digits

Digits = dict[bytes, str]


def learn_digits(device: V4l2Device) -> Digits:
    """The shapes of the digits, from pictures of a device that streams."""
    digits: Digits = {}
    for volume in _VOLUMES:
        device.write_feature("volume", volume)
        _pictures(device, 4)  # those that were drawn before
        image = _pictures(device, 1)[0]
        for place, digit in enumerate(f"{volume:3d}"):
            if digit != " ":
                digits[_cell(image, _VOLUME_LINE, _VOLUME_AT + place)] = digit
    if len(digits) != 10 or len(set(digits.values())) != 10:
        raise AssertionError(f"the digits {sorted(digits.values())} were told apart, not all ten")
    return digits


def number_in(image: Image, digits: Digits) -> int:
    """The frame number in a picture whose test pattern is white."""
    text = ""
    while (shape := _cell(image, 0, _NUMBER_AT + len(text))) in digits:
        text += digits[shape]
    if not text:
        raise AssertionError("no number stands in the picture")
    return int(text)


def _cell(image: Image, line: int, column: int) -> bytes:
    y, x = _TOP + line * _CELL_H, _LEFT + column * _CELL_W
    return bytes(np.packbits(image[y : y + _CELL_H, x : x + _CELL_W] > _GREY))


def _pictures(device: V4l2Device, count: int) -> list[Image]:
    images: list[Image] = []
    end_s = time.monotonic() + 10
    while len(images) < count and time.monotonic() < end_s:
        for event in device.frames.poll():
            images.append(device.frames.pixels(event).copy())
            device.frames.release(event)
        time.sleep(0.005)
    if len(images) < count:
        raise AssertionError(f"{len(images)} of {count} pictures came in 10 s")
    return images
