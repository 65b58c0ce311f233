"""The fields of devices that hold the settings of a sensor, with their steps and limits.

Sources: Zigbee Cluster Library, Configure Reporting command and the clusters of Measurement and
Sensing; ANSI/ASHRAE 135 (BACnet), COV_Increment and SubscribeCOV; ESPHome, Sensor Filters.
"""

from typing import Any, Literal

import numpy as np

from fusion_gym.errors import refusal

DeviceName = Literal["zigbee", "bacnet", "esphome"]
# Shortest and longest interval in seconds, and the meaning of the fields with its source.
DEVICES: dict[str, tuple[float, float, str]] = {
    "zigbee": (1.0, 65_534.0, "whole seconds, and steps of the attribute MeasuredValue "
               "(Zigbee Cluster Library, Configure Reporting)"),
    "bacnet": (1.0, 4_294_967_295.0, "COV_Increment in the object's unit, and seconds after which "
               "the centre subscribes again (ANSI/ASHRAE 135, SubscribeCOV)"),
    "esphome": (0.001, 4_294_967.0, "filters of the sensor; a delta must be exceeded "
                "(ESPHome, Sensor Filters)"),
}  # fmt: skip
_TEMPERATURE = "Temperature Measurement 0x0402", 0.01, 32_767
_HUMIDITY = "Relative Humidity 0x0405", 0.01, 65_535
# Cluster, step in the unit and most steps of MeasuredValue, by unit.
ATTRIBUTES = {
    "°C": _TEMPERATURE, "C": _TEMPERATURE, "degC": _TEMPERATURE, "K": _TEMPERATURE,
    "%": _HUMIDITY, "%RH": _HUMIDITY,
    "kPa": ("Pressure Measurement 0x0403", 0.1, 32_767),
    "hPa": ("Pressure Measurement 0x0403", 1.0, 32_767),
    "mbar": ("Pressure Measurement 0x0403", 1.0, 32_767),
    "m³/h": ("Flow Measurement 0x0404", 0.1, 65_535),
}  # fmt: skip


def longest_interval(device: DeviceName, seconds: float) -> int:
    """Return the most steps between two reports that a device holds.

    Args:
        device: kind of the device.
        seconds: length of a step.

    Raises:
        ConfigurationError: the device cannot hold one step.
    """
    low, high, _ = DEVICES[device]
    if not low <= seconds <= high:
        allowed = f"a device with an interval of {seconds:g} s, not from {low:g} to {high:g} s"
        raise refusal("device", device, allowed)
    return int(high // seconds)


def step_of(device: DeviceName | None, unit: str) -> tuple[float, float]:
    """Return step and largest value of a device's reportable change in a unit; 0 for no step."""
    _, step, most = ATTRIBUTES.get(unit if device == "zigbee" else "", ("", 0.0, np.inf))
    return step, most * step if step else most


def fields_of(
    device: DeviceName, unit: str, change: float, least: float, most: float
) -> dict[str, Any]:
    """Return the fields of a device and their values.

    Args:
        device: kind of the device.
        unit: unit of the readings.
        change: reportable change, in this unit.
        least: minimum interval, in seconds.
        most: maximum interval, in seconds.
    """
    if device == "bacnet":
        return {"COV_Increment": change, "lifetime": int(most)}
    if device == "esphome":
        either = [{"heartbeat": f"{most:g}s"}, {"delta": change}]
        return {"filters": [{"throttle": f"{least:g}s"}, {"or": either}]}
    cluster, step, _ = ATTRIBUTES.get(unit, ("unknown", 0.0, 0))
    steps = round(change / step) if step else f"{change:g} in unknown steps"
    intervals = {"minimum_reporting_interval": int(least), "maximum_reporting_interval": int(most)}
    return {"cluster": cluster, "reportable_change": steps, **intervals}
