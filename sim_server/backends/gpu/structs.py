# SPDX-License-Identifier: MIT
"""Memory that the native GPU loop, the device and Python share: the structs of loop.h and pcg_structs.cuh."""

import ctypes as c

from sim_server.backends.declarations import Declarations

LOOP = Declarations("backends/gpu/loop.h")
RECORDS = Declarations("backends/gpu/step_records.cu")
BUILD = Declarations("backends/gpu/launch_build.h")
COPIES = Declarations("backends/gpu/copy_list.cu")
PCG = Declarations("backends/gpu/pcg_structs.cuh")
STAGES = Declarations("backends/gpu/stages.cuh")
CONTACT = Declarations("backends/gpu/contact_state.cuh")
CORRECTION = Declarations("backends/gpu/correction_state.cuh")
ENERGY_RECORD, STEP_RECORDS = RECORDS.dtype("EnergyRecord"), RECORDS.dtype("StepRecords")
COPY_LIST, DEVICE_COPY = COPIES.dtype("CopyList"), COPIES.dtype("DeviceCopy")
PCG_RESULT = PCG.dtype("PcgResult")
PAIR_SUM = LOOP.dtype("PairSum")
NEWTON_RESULT = PCG.dtype("NewtonResult")
STAGE_RESULT = PCG.dtype("StageResult")
CONTACT_RESULT = PCG.dtype("ContactResult")
STAGE_STATE, STAGE_SOLVE = STAGES.dtype("StageState"), STAGES.dtype("StageSolve")
SUBSTEP_RESULT = PCG.dtype("SubstepResult")
CONTACT_STATE, CONTACT_SOLVE = CONTACT.dtype("ContactState"), CONTACT.dtype("ContactSolve")
STEP_TIMESTAMP = PCG.dtype("StepTimestamp")
RECORD_TARGET = PCG.dtype("RecordTarget")
_requests = LOOP.enumeration("Request")
REQUEST_VALUES, REQUEST_POSITIONS = _requests["REQUEST_VALUES"], _requests["REQUEST_POSITIONS"]  # of a BodyReadback
FRAME_COPIES: int = LOOP.constant("FRAME_COPIES")  # frames under way at most


@LOOP.struct
class CudaDriver(c.Structure):
    """Addresses of functions of the driver API."""


@LOOP.struct
class Mail(c.Structure):
    """New bytes for a mail slot."""


@LOOP.struct
class MailSlot(c.Structure):
    """Bytes on the device that are replaced between batches."""


@LOOP.struct
class DeviceCopy(c.Structure):
    """A copy within the device, or to it."""


@LOOP.struct
class CopyLaunch(c.Structure):
    """Copies that the device makes in one launch."""


@LOOP.struct
class DeviceChanges(c.Structure):
    """New contents of arrays, copied between the same two steps."""


@BUILD.struct
class BuildLaunch(c.Structure):
    """A build of inverses that is launched."""


@LOOP.struct
class BodyReadback(c.Structure):
    """Copies of the matrix or the positions of a body to the host."""


@LOOP.struct
class GpuLoop(c.Structure):
    """State of the native loop."""

    _anonymous_ = ("rings",)
