"""How a device is told what starts its exposures; nothing it held before is assumed."""

from __future__ import annotations

from capture.devices.aravis.features import Features
from capture.devices.aravis.handle import Handle
from capture.devices.aravis.library import aravis, translated
from capture.devices.protocol import TriggerKind, TriggerSpec
from capture.errors import DeviceError

_RATE_SLACK = 1e-3  # relative: a device rounds a rate to its own steps


class Triggers:
    """The trigger settings of one device. All calls belong on the device's own control thread."""

    def __init__(self, handle: Handle, features: Features) -> None:
        """Hold a device.

        Args:
            handle: to it.
            features: its settings.
        """
        self._handle, self._name, self._features = handle, handle.name, features
        self.problems: tuple[str, ...] = ()

    def kinds(self) -> tuple[TriggerKind, ...]:
        """What can start its exposures."""
        if not self._features.has("TriggerMode"):
            return (TriggerKind.FREE_RUN,)
        sources = self._features.entries("TriggerSource")
        found = []
        if any(source.startswith("Line") for source in sources):
            found.append(TriggerKind.HARDWARE)
        if "Software" in sources and self._features.has("TriggerSoftware"):
            found.append(TriggerKind.SOFTWARE)
        if self._features.has("ActionDeviceKey") and any(_is_action(one) for one in sources):
            found.append(TriggerKind.ACTION)
        return (*found, TriggerKind.FREE_RUN)

    def prepare(self, spec: TriggerSpec) -> float:
        """Set the device up for a kind of trigger.

        What will go wrong all the same is noted in `problems`.

        Returns:
            The exposure time that it took, us.

        Raises:
            DeviceError: when it cannot do that, saying what it offers.
        """
        kinds = self.kinds()
        if spec.kind not in kinds:
            raise DeviceError(
                f"{self._name}: asked for {spec.kind} triggers, offers {', '.join(kinds)}"
            )
        features = self._features
        self.problems = ()
        self._switch_off()
        if "Continuous" in features.entries("AcquisitionMode"):
            features.write("AcquisitionMode", "Continuous")
        exposure_us = self._expose(spec.exposure_us)
        if spec.kind is TriggerKind.FREE_RUN:
            self._run_at(1e9 / spec.period_ns)
            return exposure_us
        self._check_rate(1e9 / spec.period_ns)
        source = self._source(spec)
        selectors = features.entries("TriggerSelector")
        if selectors:
            fit = [one for one in selectors if one in ("FrameStart", "ExposureStart")]
            features.write("TriggerSelector", (fit or list(selectors))[0])
        # The mode comes first and on its own: with some firmware it races with the source and the
        # trigger is left undefined (aravis issue 1045).
        features.write("TriggerMode", "On")
        features.write("TriggerSource", source)
        if spec.kind is TriggerKind.HARDWARE and "RisingEdge" in features.entries(
            "TriggerActivation"
        ):
            features.write("TriggerActivation", "RisingEdge")
        if spec.kind is TriggerKind.ACTION:
            self._listen(spec, source)
        return exposure_us

    def fire(self) -> None:
        """Expose now."""
        with translated(self._name, "a software trigger"):
            self._handle.camera.software_trigger()

    def _switch_off(self) -> None:
        """Switch every trigger off: a device keeps what another program left in it."""
        features = self._features
        if not features.has("TriggerMode"):
            return
        selectors = features.entries("TriggerSelector")
        for selector in selectors:
            features.write("TriggerSelector", selector)
            if features.has("TriggerMode"):
                features.write("TriggerMode", "Off")
        if not selectors:
            features.write("TriggerMode", "Off")

    def _expose(self, asked_us: float) -> float:
        library, camera = aravis(), self._handle.camera
        with translated(self._name, f"an exposure of {asked_us:g} us"):
            if not camera.is_exposure_time_available():
                return -1.0
            if camera.is_exposure_auto_available():
                camera.set_exposure_time_auto(library.Auto.OFF)
            least, most = camera.get_exposure_time_bounds()
            if not least <= asked_us <= most:
                raise DeviceError(
                    f"{self._name}: asked for an exposure of {asked_us:g} us, "
                    f"offers {least:g} to {most:g}"
                )
            camera.set_exposure_time(asked_us)
            return float(camera.get_exposure_time())

    def _run_at(self, rate_hz: float) -> None:
        camera = self._handle.camera
        with translated(self._name, f"a rate of {rate_hz:g} Hz"):
            if not camera.is_frame_rate_available():
                raise DeviceError(f"{self._name}: asked for {rate_hz:g} Hz, it has no set rate")
            least, most = camera.get_frame_rate_bounds()
            if not least * (1 - _RATE_SLACK) <= rate_hz <= most * (1 + _RATE_SLACK):
                raise DeviceError(
                    f"{self._name}: asked for {rate_hz:g} Hz, offers {least:g} to {most:g} "
                    f"with its present exposure and image size"
                )
            camera.set_frame_rate(rate_hz)
            found = float(camera.get_frame_rate())
        if abs(found - rate_hz) > _RATE_SLACK * rate_hz:
            raise DeviceError(f"{self._name}: asked for {rate_hz:g} Hz, runs at {found:g}")

    def _check_rate(self, rate_hz: float) -> None:
        """Note when triggers come faster than the device can expose and read out."""
        camera = self._handle.camera
        with translated(self._name, "its highest rate"):
            if not camera.is_frame_rate_available():
                return
            most = float(camera.get_frame_rate_bounds()[1])
        if 0 < most < rate_hz * (1 - _RATE_SLACK):
            self.problems = (
                f"triggers come at {rate_hz:g} Hz, and with its present exposure and image size "
                f"it takes {most:.4g} Hz, so it will miss some; shorten the exposure, make the "
                f"image smaller, or lower the rate",
            )

    def _source(self, spec: TriggerSpec) -> str:
        offered = self._features.entries("TriggerSource")
        if spec.kind is TriggerKind.SOFTWARE:
            return "Software"
        if spec.kind is TriggerKind.ACTION:
            fitting = [one for one in offered if _is_action(one)]
        else:
            fitting = [one for one in offered if one.startswith("Line")]
        if spec.source and spec.source not in fitting:
            raise DeviceError(
                f"{self._name}: asked for triggers from {spec.source}, offers {', '.join(fitting)}"
            )
        return spec.source or fitting[0]

    def _listen(self, spec: TriggerSpec, source: str) -> None:
        """Tell the device which action commands are meant for it."""
        features, keys = self._features, spec.action
        features.write("ActionDeviceKey", keys.device_key)
        if features.has("ActionSelector"):
            number = int("".join(c for c in source if c.isdigit()) or 0)
            least, most = features.bounds("ActionSelector")
            features.write("ActionSelector", int(min(max(number, least), most)))
        features.write("ActionGroupKey", keys.group_key)
        features.write("ActionGroupMask", keys.group_mask)


def _is_action(source: str) -> bool:
    return source.startswith("Action")
