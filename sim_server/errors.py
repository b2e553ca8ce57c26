# SPDX-License-Identifier: MIT
"""The one error that a user of the commands is meant to read."""


class InputError(Exception):
    """Bad input: a scene, mesh, option or expression that cannot be used.

    The text names the file, the field, the value and what is allowed. Commands print it without a traceback
    and exit with code 2.
    """


class NameTaken(InputError):
    """Another server that this one is linked with has its name."""


class DeviceError(InputError):
    """The device asked for is not there or not usable; the message says what to do."""


class DeviceLost(RuntimeError):
    """The GPU failed while the simulation ran; nothing on it can be used any more."""
