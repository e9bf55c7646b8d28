"""The calibration a session uses: which, how old, and whether a device has moved since."""

from capture.calibration_link.link import (
    CalibrationLink,
    LinkStanding,
    calibration_standing,
    link_calibration,
    linked_cameras,
    linked_reference,
    read_link,
)
from capture.calibration_link.reference import (
    DeviceReference,
    SceneFinding,
    check_static_scene,
    make_reference,
    read_reference,
    reference_of_take,
)
from capture.calibration_link.sharpness import sharpness
from capture.calibration_link.static_scene import Motion, measure_motion, small_picture

__all__ = [
    "CalibrationLink",
    "DeviceReference",
    "LinkStanding",
    "Motion",
    "SceneFinding",
    "calibration_standing",
    "check_static_scene",
    "link_calibration",
    "linked_cameras",
    "linked_reference",
    "make_reference",
    "measure_motion",
    "read_link",
    "read_reference",
    "reference_of_take",
    "sharpness",
    "small_picture",
]
