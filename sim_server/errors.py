# SPDX-License-Identifier: MIT
"""Errors whose text is written for the user of the commands."""


class InputError(Exception):
    """Bad input: a scene, mesh, option or expression that cannot be used.

    The text names the file, the field, the value and what is allowed. Commands print it without a traceback
    and exit with code 2.
    """


class NameTaken(InputError):
    """A linked server has the same name."""


class DeviceError(InputError):
    """The requested device is missing or not usable; the message says what to do."""


class DeviceLost(RuntimeError):
    """The GPU failed while the simulation ran; nothing on it can be used any more."""
