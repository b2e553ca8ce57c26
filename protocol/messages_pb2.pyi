from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class SolveStatus(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    CONVERGED: _ClassVar[SolveStatus]
    MAX_ITERATIONS: _ClassVar[SolveStatus]
    BUDGET: _ClassVar[SolveStatus]
    BREAKDOWN_MATRIX: _ClassVar[SolveStatus]
    BREAKDOWN_PRECONDITIONER: _ClassVar[SolveStatus]
    NOT_FINITE: _ClassVar[SolveStatus]
    MAX_LINEARIZATIONS: _ClassVar[SolveStatus]
    RUNAWAY: _ClassVar[SolveStatus]
    CONTACT: _ClassVar[SolveStatus]

class StepForm(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    ONE_SOLVE: _ClassVar[StepForm]
    ITERATE: _ClassVar[StepForm]
    FACTOR: _ClassVar[StepForm]
    EULER: _ClassVar[StepForm]
CONVERGED: SolveStatus
MAX_ITERATIONS: SolveStatus
BUDGET: SolveStatus
BREAKDOWN_MATRIX: SolveStatus
BREAKDOWN_PRECONDITIONER: SolveStatus
NOT_FINITE: SolveStatus
MAX_LINEARIZATIONS: SolveStatus
RUNAWAY: SolveStatus
CONTACT: SolveStatus
ONE_SOLVE: StepForm
ITERATE: StepForm
FACTOR: StepForm
EULER: StepForm

class Header(_message.Message):
    __slots__ = ("protocol", "incarnation", "object", "epoch", "sequence")
    PROTOCOL_FIELD_NUMBER: _ClassVar[int]
    INCARNATION_FIELD_NUMBER: _ClassVar[int]
    OBJECT_FIELD_NUMBER: _ClassVar[int]
    EPOCH_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    protocol: int
    incarnation: int
    object: str
    epoch: int
    sequence: int
    def __init__(self, protocol: _Optional[int] = ..., incarnation: _Optional[int] = ..., object: _Optional[str] = ..., epoch: _Optional[int] = ..., sequence: _Optional[int] = ...) -> None: ...

class Slot(_message.Message):
    __slots__ = ("segment", "offset", "capacity", "generation")
    SEGMENT_FIELD_NUMBER: _ClassVar[int]
    OFFSET_FIELD_NUMBER: _ClassVar[int]
    CAPACITY_FIELD_NUMBER: _ClassVar[int]
    GENERATION_FIELD_NUMBER: _ClassVar[int]
    segment: str
    offset: int
    capacity: int
    generation: int
    def __init__(self, segment: _Optional[str] = ..., offset: _Optional[int] = ..., capacity: _Optional[int] = ..., generation: _Optional[int] = ...) -> None: ...

class DeviceSlot(_message.Message):
    __slots__ = ("handle", "capacity", "generation")
    HANDLE_FIELD_NUMBER: _ClassVar[int]
    CAPACITY_FIELD_NUMBER: _ClassVar[int]
    GENERATION_FIELD_NUMBER: _ClassVar[int]
    handle: bytes
    capacity: int
    generation: int
    def __init__(self, handle: _Optional[bytes] = ..., capacity: _Optional[int] = ..., generation: _Optional[int] = ...) -> None: ...

class Scene(_message.Message):
    __slots__ = ("header", "name", "toml", "resolved", "dt", "started_ns", "software", "objects", "server", "device", "build", "obstacles")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    NAME_FIELD_NUMBER: _ClassVar[int]
    TOML_FIELD_NUMBER: _ClassVar[int]
    RESOLVED_FIELD_NUMBER: _ClassVar[int]
    DT_FIELD_NUMBER: _ClassVar[int]
    STARTED_NS_FIELD_NUMBER: _ClassVar[int]
    SOFTWARE_FIELD_NUMBER: _ClassVar[int]
    OBJECTS_FIELD_NUMBER: _ClassVar[int]
    SERVER_FIELD_NUMBER: _ClassVar[int]
    DEVICE_FIELD_NUMBER: _ClassVar[int]
    BUILD_FIELD_NUMBER: _ClassVar[int]
    OBSTACLES_FIELD_NUMBER: _ClassVar[int]
    header: Header
    name: str
    toml: str
    resolved: str
    dt: float
    started_ns: int
    software: str
    objects: _containers.RepeatedScalarFieldContainer[str]
    server: str
    device: str
    build: str
    obstacles: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., name: _Optional[str] = ..., toml: _Optional[str] = ..., resolved: _Optional[str] = ..., dt: _Optional[float] = ..., started_ns: _Optional[int] = ..., software: _Optional[str] = ..., objects: _Optional[_Iterable[str]] = ..., server: _Optional[str] = ..., device: _Optional[str] = ..., build: _Optional[str] = ..., obstacles: _Optional[_Iterable[str]] = ...) -> None: ...

class Topology(_message.Message):
    __slots__ = ("header", "nodes", "rest", "tets", "triangles", "row_start", "columns", "fixed", "young", "poisson", "reference", "skin_nodes", "skin_weights", "skin_triangles", "removed", "cut", "quadratic", "groups")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    NODES_FIELD_NUMBER: _ClassVar[int]
    REST_FIELD_NUMBER: _ClassVar[int]
    TETS_FIELD_NUMBER: _ClassVar[int]
    TRIANGLES_FIELD_NUMBER: _ClassVar[int]
    ROW_START_FIELD_NUMBER: _ClassVar[int]
    COLUMNS_FIELD_NUMBER: _ClassVar[int]
    FIXED_FIELD_NUMBER: _ClassVar[int]
    YOUNG_FIELD_NUMBER: _ClassVar[int]
    POISSON_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_FIELD_NUMBER: _ClassVar[int]
    SKIN_NODES_FIELD_NUMBER: _ClassVar[int]
    SKIN_WEIGHTS_FIELD_NUMBER: _ClassVar[int]
    SKIN_TRIANGLES_FIELD_NUMBER: _ClassVar[int]
    REMOVED_FIELD_NUMBER: _ClassVar[int]
    CUT_FIELD_NUMBER: _ClassVar[int]
    QUADRATIC_FIELD_NUMBER: _ClassVar[int]
    GROUPS_FIELD_NUMBER: _ClassVar[int]
    header: Header
    nodes: int
    rest: bytes
    tets: bytes
    triangles: bytes
    row_start: bytes
    columns: bytes
    fixed: bytes
    young: bytes
    poisson: bytes
    reference: bytes
    skin_nodes: bytes
    skin_weights: bytes
    skin_triangles: bytes
    removed: bytes
    cut: int
    quadratic: bytes
    groups: _containers.RepeatedCompositeFieldContainer[Group]
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., nodes: _Optional[int] = ..., rest: _Optional[bytes] = ..., tets: _Optional[bytes] = ..., triangles: _Optional[bytes] = ..., row_start: _Optional[bytes] = ..., columns: _Optional[bytes] = ..., fixed: _Optional[bytes] = ..., young: _Optional[bytes] = ..., poisson: _Optional[bytes] = ..., reference: _Optional[bytes] = ..., skin_nodes: _Optional[bytes] = ..., skin_weights: _Optional[bytes] = ..., skin_triangles: _Optional[bytes] = ..., removed: _Optional[bytes] = ..., cut: _Optional[int] = ..., quadratic: _Optional[bytes] = ..., groups: _Optional[_Iterable[_Union[Group, _Mapping]]] = ...) -> None: ...

class Group(_message.Message):
    __slots__ = ("name", "elements", "faces", "nodes")
    NAME_FIELD_NUMBER: _ClassVar[int]
    ELEMENTS_FIELD_NUMBER: _ClassVar[int]
    FACES_FIELD_NUMBER: _ClassVar[int]
    NODES_FIELD_NUMBER: _ClassVar[int]
    name: str
    elements: bytes
    faces: bytes
    nodes: bytes
    def __init__(self, name: _Optional[str] = ..., elements: _Optional[bytes] = ..., faces: _Optional[bytes] = ..., nodes: _Optional[bytes] = ...) -> None: ...

class Matrix(_message.Message):
    __slots__ = ("header", "step", "warp", "blocks", "checksum", "factor_dtype", "method", "known_patterns", "lease", "factor_slot", "matrix_slot", "worker", "drop_tolerance", "fill", "omega", "nodes", "part_bytes", "topology", "device_matrix", "device_factor")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    WARP_FIELD_NUMBER: _ClassVar[int]
    BLOCKS_FIELD_NUMBER: _ClassVar[int]
    CHECKSUM_FIELD_NUMBER: _ClassVar[int]
    FACTOR_DTYPE_FIELD_NUMBER: _ClassVar[int]
    METHOD_FIELD_NUMBER: _ClassVar[int]
    KNOWN_PATTERNS_FIELD_NUMBER: _ClassVar[int]
    LEASE_FIELD_NUMBER: _ClassVar[int]
    FACTOR_SLOT_FIELD_NUMBER: _ClassVar[int]
    MATRIX_SLOT_FIELD_NUMBER: _ClassVar[int]
    WORKER_FIELD_NUMBER: _ClassVar[int]
    DROP_TOLERANCE_FIELD_NUMBER: _ClassVar[int]
    FILL_FIELD_NUMBER: _ClassVar[int]
    OMEGA_FIELD_NUMBER: _ClassVar[int]
    NODES_FIELD_NUMBER: _ClassVar[int]
    PART_BYTES_FIELD_NUMBER: _ClassVar[int]
    TOPOLOGY_FIELD_NUMBER: _ClassVar[int]
    DEVICE_MATRIX_FIELD_NUMBER: _ClassVar[int]
    DEVICE_FACTOR_FIELD_NUMBER: _ClassVar[int]
    header: Header
    step: int
    warp: bool
    blocks: int
    checksum: int
    factor_dtype: str
    method: str
    known_patterns: _containers.RepeatedScalarFieldContainer[int]
    lease: float
    factor_slot: Slot
    matrix_slot: Slot
    worker: str
    drop_tolerance: float
    fill: float
    omega: float
    nodes: int
    part_bytes: int
    topology: int
    device_matrix: DeviceSlot
    device_factor: DeviceSlot
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., step: _Optional[int] = ..., warp: _Optional[bool] = ..., blocks: _Optional[int] = ..., checksum: _Optional[int] = ..., factor_dtype: _Optional[str] = ..., method: _Optional[str] = ..., known_patterns: _Optional[_Iterable[int]] = ..., lease: _Optional[float] = ..., factor_slot: _Optional[_Union[Slot, _Mapping]] = ..., matrix_slot: _Optional[_Union[Slot, _Mapping]] = ..., worker: _Optional[str] = ..., drop_tolerance: _Optional[float] = ..., fill: _Optional[float] = ..., omega: _Optional[float] = ..., nodes: _Optional[int] = ..., part_bytes: _Optional[int] = ..., topology: _Optional[int] = ..., device_matrix: _Optional[_Union[DeviceSlot, _Mapping]] = ..., device_factor: _Optional[_Union[DeviceSlot, _Mapping]] = ...) -> None: ...

class FactorPattern(_message.Message):
    __slots__ = ("header", "id", "size", "supernodes", "nonzeros", "permutation", "super_start", "row_start", "rows")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    ID_FIELD_NUMBER: _ClassVar[int]
    SIZE_FIELD_NUMBER: _ClassVar[int]
    SUPERNODES_FIELD_NUMBER: _ClassVar[int]
    NONZEROS_FIELD_NUMBER: _ClassVar[int]
    PERMUTATION_FIELD_NUMBER: _ClassVar[int]
    SUPER_START_FIELD_NUMBER: _ClassVar[int]
    ROW_START_FIELD_NUMBER: _ClassVar[int]
    ROWS_FIELD_NUMBER: _ClassVar[int]
    header: Header
    id: int
    size: int
    supernodes: int
    nonzeros: int
    permutation: bytes
    super_start: bytes
    row_start: bytes
    rows: bytes
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., id: _Optional[int] = ..., size: _Optional[int] = ..., supernodes: _Optional[int] = ..., nonzeros: _Optional[int] = ..., permutation: _Optional[bytes] = ..., super_start: _Optional[bytes] = ..., row_start: _Optional[bytes] = ..., rows: _Optional[bytes] = ...) -> None: ...

class Factor(_message.Message):
    __slots__ = ("header", "step", "warp", "pattern", "dtype", "nonzeros", "checksum", "slot", "worker", "seconds", "failure", "job", "matrix_shared", "remedy", "device_slot", "parts")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    WARP_FIELD_NUMBER: _ClassVar[int]
    PATTERN_FIELD_NUMBER: _ClassVar[int]
    DTYPE_FIELD_NUMBER: _ClassVar[int]
    NONZEROS_FIELD_NUMBER: _ClassVar[int]
    CHECKSUM_FIELD_NUMBER: _ClassVar[int]
    SLOT_FIELD_NUMBER: _ClassVar[int]
    WORKER_FIELD_NUMBER: _ClassVar[int]
    SECONDS_FIELD_NUMBER: _ClassVar[int]
    FAILURE_FIELD_NUMBER: _ClassVar[int]
    JOB_FIELD_NUMBER: _ClassVar[int]
    MATRIX_SHARED_FIELD_NUMBER: _ClassVar[int]
    REMEDY_FIELD_NUMBER: _ClassVar[int]
    DEVICE_SLOT_FIELD_NUMBER: _ClassVar[int]
    PARTS_FIELD_NUMBER: _ClassVar[int]
    header: Header
    step: int
    warp: bool
    pattern: int
    dtype: str
    nonzeros: int
    checksum: int
    slot: Slot
    worker: str
    seconds: float
    failure: str
    job: int
    matrix_shared: bool
    remedy: str
    device_slot: DeviceSlot
    parts: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., step: _Optional[int] = ..., warp: _Optional[bool] = ..., pattern: _Optional[int] = ..., dtype: _Optional[str] = ..., nonzeros: _Optional[int] = ..., checksum: _Optional[int] = ..., slot: _Optional[_Union[Slot, _Mapping]] = ..., worker: _Optional[str] = ..., seconds: _Optional[float] = ..., failure: _Optional[str] = ..., job: _Optional[int] = ..., matrix_shared: _Optional[bool] = ..., remedy: _Optional[str] = ..., device_slot: _Optional[_Union[DeviceSlot, _Mapping]] = ..., parts: _Optional[_Iterable[int]] = ...) -> None: ...

class FactorPart(_message.Message):
    __slots__ = ("header", "job", "number", "slot")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    JOB_FIELD_NUMBER: _ClassVar[int]
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    SLOT_FIELD_NUMBER: _ClassVar[int]
    header: Header
    job: int
    number: int
    slot: Slot
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., job: _Optional[int] = ..., number: _Optional[int] = ..., slot: _Optional[_Union[Slot, _Mapping]] = ...) -> None: ...

class MatrixBatch(_message.Message):
    __slots__ = ("header", "worker", "factor_dtype", "method", "drop_tolerance", "fill", "omega", "matrix_slot", "factor_slot", "objects", "epochs", "jobs", "steps", "warps", "blocks", "checksums", "rooms", "leases", "known", "known_patterns", "topologies")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    WORKER_FIELD_NUMBER: _ClassVar[int]
    FACTOR_DTYPE_FIELD_NUMBER: _ClassVar[int]
    METHOD_FIELD_NUMBER: _ClassVar[int]
    DROP_TOLERANCE_FIELD_NUMBER: _ClassVar[int]
    FILL_FIELD_NUMBER: _ClassVar[int]
    OMEGA_FIELD_NUMBER: _ClassVar[int]
    MATRIX_SLOT_FIELD_NUMBER: _ClassVar[int]
    FACTOR_SLOT_FIELD_NUMBER: _ClassVar[int]
    OBJECTS_FIELD_NUMBER: _ClassVar[int]
    EPOCHS_FIELD_NUMBER: _ClassVar[int]
    JOBS_FIELD_NUMBER: _ClassVar[int]
    STEPS_FIELD_NUMBER: _ClassVar[int]
    WARPS_FIELD_NUMBER: _ClassVar[int]
    BLOCKS_FIELD_NUMBER: _ClassVar[int]
    CHECKSUMS_FIELD_NUMBER: _ClassVar[int]
    ROOMS_FIELD_NUMBER: _ClassVar[int]
    LEASES_FIELD_NUMBER: _ClassVar[int]
    KNOWN_FIELD_NUMBER: _ClassVar[int]
    KNOWN_PATTERNS_FIELD_NUMBER: _ClassVar[int]
    TOPOLOGIES_FIELD_NUMBER: _ClassVar[int]
    header: Header
    worker: str
    factor_dtype: str
    method: str
    drop_tolerance: float
    fill: float
    omega: float
    matrix_slot: Slot
    factor_slot: Slot
    objects: _containers.RepeatedScalarFieldContainer[str]
    epochs: _containers.RepeatedScalarFieldContainer[int]
    jobs: _containers.RepeatedScalarFieldContainer[int]
    steps: _containers.RepeatedScalarFieldContainer[int]
    warps: _containers.RepeatedScalarFieldContainer[bool]
    blocks: _containers.RepeatedScalarFieldContainer[int]
    checksums: _containers.RepeatedScalarFieldContainer[int]
    rooms: _containers.RepeatedScalarFieldContainer[int]
    leases: _containers.RepeatedScalarFieldContainer[float]
    known: _containers.RepeatedScalarFieldContainer[int]
    known_patterns: _containers.RepeatedScalarFieldContainer[int]
    topologies: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., worker: _Optional[str] = ..., factor_dtype: _Optional[str] = ..., method: _Optional[str] = ..., drop_tolerance: _Optional[float] = ..., fill: _Optional[float] = ..., omega: _Optional[float] = ..., matrix_slot: _Optional[_Union[Slot, _Mapping]] = ..., factor_slot: _Optional[_Union[Slot, _Mapping]] = ..., objects: _Optional[_Iterable[str]] = ..., epochs: _Optional[_Iterable[int]] = ..., jobs: _Optional[_Iterable[int]] = ..., steps: _Optional[_Iterable[int]] = ..., warps: _Optional[_Iterable[bool]] = ..., blocks: _Optional[_Iterable[int]] = ..., checksums: _Optional[_Iterable[int]] = ..., rooms: _Optional[_Iterable[int]] = ..., leases: _Optional[_Iterable[float]] = ..., known: _Optional[_Iterable[int]] = ..., known_patterns: _Optional[_Iterable[int]] = ..., topologies: _Optional[_Iterable[int]] = ...) -> None: ...

class FactorBatch(_message.Message):
    __slots__ = ("header", "worker", "jobs", "patterns", "nonzeros", "checksums", "seconds", "failures", "remedies", "slot", "matrix_shared")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    WORKER_FIELD_NUMBER: _ClassVar[int]
    JOBS_FIELD_NUMBER: _ClassVar[int]
    PATTERNS_FIELD_NUMBER: _ClassVar[int]
    NONZEROS_FIELD_NUMBER: _ClassVar[int]
    CHECKSUMS_FIELD_NUMBER: _ClassVar[int]
    SECONDS_FIELD_NUMBER: _ClassVar[int]
    FAILURES_FIELD_NUMBER: _ClassVar[int]
    REMEDIES_FIELD_NUMBER: _ClassVar[int]
    SLOT_FIELD_NUMBER: _ClassVar[int]
    MATRIX_SHARED_FIELD_NUMBER: _ClassVar[int]
    header: Header
    worker: str
    jobs: _containers.RepeatedScalarFieldContainer[int]
    patterns: _containers.RepeatedScalarFieldContainer[int]
    nonzeros: _containers.RepeatedScalarFieldContainer[int]
    checksums: _containers.RepeatedScalarFieldContainer[int]
    seconds: _containers.RepeatedScalarFieldContainer[float]
    failures: _containers.RepeatedScalarFieldContainer[str]
    remedies: _containers.RepeatedScalarFieldContainer[str]
    slot: Slot
    matrix_shared: bool
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., worker: _Optional[str] = ..., jobs: _Optional[_Iterable[int]] = ..., patterns: _Optional[_Iterable[int]] = ..., nonzeros: _Optional[_Iterable[int]] = ..., checksums: _Optional[_Iterable[int]] = ..., seconds: _Optional[_Iterable[float]] = ..., failures: _Optional[_Iterable[str]] = ..., remedies: _Optional[_Iterable[str]] = ..., slot: _Optional[_Union[Slot, _Mapping]] = ..., matrix_shared: _Optional[bool] = ...) -> None: ...

class WorkerInfo(_message.Message):
    __slots__ = ("header", "worker", "pid", "host", "library", "threads", "shared_memory", "jobs", "failures", "superseded", "refused", "bulk_shared", "bulk_copied", "builds", "idle", "share", "leaving", "most_jobs", "batches", "together", "device_memory")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    WORKER_FIELD_NUMBER: _ClassVar[int]
    PID_FIELD_NUMBER: _ClassVar[int]
    HOST_FIELD_NUMBER: _ClassVar[int]
    LIBRARY_FIELD_NUMBER: _ClassVar[int]
    THREADS_FIELD_NUMBER: _ClassVar[int]
    SHARED_MEMORY_FIELD_NUMBER: _ClassVar[int]
    JOBS_FIELD_NUMBER: _ClassVar[int]
    FAILURES_FIELD_NUMBER: _ClassVar[int]
    SUPERSEDED_FIELD_NUMBER: _ClassVar[int]
    REFUSED_FIELD_NUMBER: _ClassVar[int]
    BULK_SHARED_FIELD_NUMBER: _ClassVar[int]
    BULK_COPIED_FIELD_NUMBER: _ClassVar[int]
    BUILDS_FIELD_NUMBER: _ClassVar[int]
    IDLE_FIELD_NUMBER: _ClassVar[int]
    SHARE_FIELD_NUMBER: _ClassVar[int]
    LEAVING_FIELD_NUMBER: _ClassVar[int]
    MOST_JOBS_FIELD_NUMBER: _ClassVar[int]
    BATCHES_FIELD_NUMBER: _ClassVar[int]
    TOGETHER_FIELD_NUMBER: _ClassVar[int]
    DEVICE_MEMORY_FIELD_NUMBER: _ClassVar[int]
    header: Header
    worker: str
    pid: int
    host: str
    library: str
    threads: int
    shared_memory: bool
    jobs: int
    failures: int
    superseded: int
    refused: int
    bulk_shared: int
    bulk_copied: int
    builds: bool
    idle: bool
    share: float
    leaving: bool
    most_jobs: int
    batches: bool
    together: int
    device_memory: bool
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., worker: _Optional[str] = ..., pid: _Optional[int] = ..., host: _Optional[str] = ..., library: _Optional[str] = ..., threads: _Optional[int] = ..., shared_memory: _Optional[bool] = ..., jobs: _Optional[int] = ..., failures: _Optional[int] = ..., superseded: _Optional[int] = ..., refused: _Optional[int] = ..., bulk_shared: _Optional[int] = ..., bulk_copied: _Optional[int] = ..., builds: _Optional[bool] = ..., idle: _Optional[bool] = ..., share: _Optional[float] = ..., leaving: _Optional[bool] = ..., most_jobs: _Optional[int] = ..., batches: _Optional[bool] = ..., together: _Optional[int] = ..., device_memory: _Optional[bool] = ...) -> None: ...

class Need(_message.Message):
    __slots__ = ("header", "lost", "workers")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    LOST_FIELD_NUMBER: _ClassVar[int]
    WORKERS_FIELD_NUMBER: _ClassVar[int]
    header: Header
    lost: float
    workers: float
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., lost: _Optional[float] = ..., workers: _Optional[float] = ...) -> None: ...

class Echo(_message.Message):
    __slots__ = ("header", "slot", "nonce", "settled", "on_device", "device")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    SLOT_FIELD_NUMBER: _ClassVar[int]
    NONCE_FIELD_NUMBER: _ClassVar[int]
    SETTLED_FIELD_NUMBER: _ClassVar[int]
    ON_DEVICE_FIELD_NUMBER: _ClassVar[int]
    DEVICE_FIELD_NUMBER: _ClassVar[int]
    header: Header
    slot: Slot
    nonce: int
    settled: bool
    on_device: bool
    device: DeviceSlot
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., slot: _Optional[_Union[Slot, _Mapping]] = ..., nonce: _Optional[int] = ..., settled: _Optional[bool] = ..., on_device: _Optional[bool] = ..., device: _Optional[_Union[DeviceSlot, _Mapping]] = ...) -> None: ...

class ObjectStep(_message.Message):
    __slots__ = ("header", "step", "time", "iterations", "residual", "status", "factor_step", "factor_age", "preconditioner", "assemble_seconds", "solve_seconds", "integrate_seconds", "step_seconds", "late_seconds", "cpu_seconds", "fallbacks", "excess", "interactions", "asked", "probe", "factor_age_bound", "linearizations", "nonlinear_residual", "kinetic_energy", "elastic_energy", "gravity_energy", "work", "dissipated", "form", "estimate", "contacts", "passes", "clipped", "contact_residual", "substeps", "halvings", "at_rest", "stable_step", "solve_error", "step_error", "readings", "left_out", "reactions")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    TIME_FIELD_NUMBER: _ClassVar[int]
    ITERATIONS_FIELD_NUMBER: _ClassVar[int]
    RESIDUAL_FIELD_NUMBER: _ClassVar[int]
    STATUS_FIELD_NUMBER: _ClassVar[int]
    FACTOR_STEP_FIELD_NUMBER: _ClassVar[int]
    FACTOR_AGE_FIELD_NUMBER: _ClassVar[int]
    PRECONDITIONER_FIELD_NUMBER: _ClassVar[int]
    ASSEMBLE_SECONDS_FIELD_NUMBER: _ClassVar[int]
    SOLVE_SECONDS_FIELD_NUMBER: _ClassVar[int]
    INTEGRATE_SECONDS_FIELD_NUMBER: _ClassVar[int]
    STEP_SECONDS_FIELD_NUMBER: _ClassVar[int]
    LATE_SECONDS_FIELD_NUMBER: _ClassVar[int]
    CPU_SECONDS_FIELD_NUMBER: _ClassVar[int]
    FALLBACKS_FIELD_NUMBER: _ClassVar[int]
    EXCESS_FIELD_NUMBER: _ClassVar[int]
    INTERACTIONS_FIELD_NUMBER: _ClassVar[int]
    ASKED_FIELD_NUMBER: _ClassVar[int]
    PROBE_FIELD_NUMBER: _ClassVar[int]
    FACTOR_AGE_BOUND_FIELD_NUMBER: _ClassVar[int]
    LINEARIZATIONS_FIELD_NUMBER: _ClassVar[int]
    NONLINEAR_RESIDUAL_FIELD_NUMBER: _ClassVar[int]
    KINETIC_ENERGY_FIELD_NUMBER: _ClassVar[int]
    ELASTIC_ENERGY_FIELD_NUMBER: _ClassVar[int]
    GRAVITY_ENERGY_FIELD_NUMBER: _ClassVar[int]
    WORK_FIELD_NUMBER: _ClassVar[int]
    DISSIPATED_FIELD_NUMBER: _ClassVar[int]
    FORM_FIELD_NUMBER: _ClassVar[int]
    ESTIMATE_FIELD_NUMBER: _ClassVar[int]
    CONTACTS_FIELD_NUMBER: _ClassVar[int]
    PASSES_FIELD_NUMBER: _ClassVar[int]
    CLIPPED_FIELD_NUMBER: _ClassVar[int]
    CONTACT_RESIDUAL_FIELD_NUMBER: _ClassVar[int]
    SUBSTEPS_FIELD_NUMBER: _ClassVar[int]
    HALVINGS_FIELD_NUMBER: _ClassVar[int]
    AT_REST_FIELD_NUMBER: _ClassVar[int]
    STABLE_STEP_FIELD_NUMBER: _ClassVar[int]
    SOLVE_ERROR_FIELD_NUMBER: _ClassVar[int]
    STEP_ERROR_FIELD_NUMBER: _ClassVar[int]
    READINGS_FIELD_NUMBER: _ClassVar[int]
    LEFT_OUT_FIELD_NUMBER: _ClassVar[int]
    REACTIONS_FIELD_NUMBER: _ClassVar[int]
    header: Header
    step: int
    time: float
    iterations: int
    residual: float
    status: SolveStatus
    factor_step: int
    factor_age: int
    preconditioner: str
    assemble_seconds: float
    solve_seconds: float
    integrate_seconds: float
    step_seconds: float
    late_seconds: float
    cpu_seconds: float
    fallbacks: int
    excess: float
    interactions: _containers.RepeatedCompositeFieldContainer[Interaction]
    asked: str
    probe: int
    factor_age_bound: int
    linearizations: int
    nonlinear_residual: float
    kinetic_energy: float
    elastic_energy: float
    gravity_energy: float
    work: float
    dissipated: float
    form: StepForm
    estimate: float
    contacts: int
    passes: int
    clipped: int
    contact_residual: float
    substeps: int
    halvings: int
    at_rest: bool
    stable_step: float
    solve_error: float
    step_error: float
    readings: _containers.RepeatedCompositeFieldContainer[Reading]
    left_out: int
    reactions: _containers.RepeatedCompositeFieldContainer[Reaction]
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., step: _Optional[int] = ..., time: _Optional[float] = ..., iterations: _Optional[int] = ..., residual: _Optional[float] = ..., status: _Optional[_Union[SolveStatus, str]] = ..., factor_step: _Optional[int] = ..., factor_age: _Optional[int] = ..., preconditioner: _Optional[str] = ..., assemble_seconds: _Optional[float] = ..., solve_seconds: _Optional[float] = ..., integrate_seconds: _Optional[float] = ..., step_seconds: _Optional[float] = ..., late_seconds: _Optional[float] = ..., cpu_seconds: _Optional[float] = ..., fallbacks: _Optional[int] = ..., excess: _Optional[float] = ..., interactions: _Optional[_Iterable[_Union[Interaction, _Mapping]]] = ..., asked: _Optional[str] = ..., probe: _Optional[int] = ..., factor_age_bound: _Optional[int] = ..., linearizations: _Optional[int] = ..., nonlinear_residual: _Optional[float] = ..., kinetic_energy: _Optional[float] = ..., elastic_energy: _Optional[float] = ..., gravity_energy: _Optional[float] = ..., work: _Optional[float] = ..., dissipated: _Optional[float] = ..., form: _Optional[_Union[StepForm, str]] = ..., estimate: _Optional[float] = ..., contacts: _Optional[int] = ..., passes: _Optional[int] = ..., clipped: _Optional[int] = ..., contact_residual: _Optional[float] = ..., substeps: _Optional[int] = ..., halvings: _Optional[int] = ..., at_rest: _Optional[bool] = ..., stable_step: _Optional[float] = ..., solve_error: _Optional[float] = ..., step_error: _Optional[float] = ..., readings: _Optional[_Iterable[_Union[Reading, _Mapping]]] = ..., left_out: _Optional[int] = ..., reactions: _Optional[_Iterable[_Union[Reaction, _Mapping]]] = ...) -> None: ...

class Steps(_message.Message):
    __slots__ = ("header", "steps", "moves", "left_out")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    STEPS_FIELD_NUMBER: _ClassVar[int]
    MOVES_FIELD_NUMBER: _ClassVar[int]
    LEFT_OUT_FIELD_NUMBER: _ClassVar[int]
    header: Header
    steps: _containers.RepeatedCompositeFieldContainer[ObjectStep]
    moves: _containers.RepeatedCompositeFieldContainer[MoveTaken]
    left_out: int
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., steps: _Optional[_Iterable[_Union[ObjectStep, _Mapping]]] = ..., moves: _Optional[_Iterable[_Union[MoveTaken, _Mapping]]] = ..., left_out: _Optional[int] = ...) -> None: ...

class MoveTaken(_message.Message):
    __slots__ = ("client", "obstacle", "grab", "move", "step")
    CLIENT_FIELD_NUMBER: _ClassVar[int]
    OBSTACLE_FIELD_NUMBER: _ClassVar[int]
    GRAB_FIELD_NUMBER: _ClassVar[int]
    MOVE_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    client: str
    obstacle: str
    grab: int
    move: int
    step: int
    def __init__(self, client: _Optional[str] = ..., obstacle: _Optional[str] = ..., grab: _Optional[int] = ..., move: _Optional[int] = ..., step: _Optional[int] = ...) -> None: ...

class State(_message.Message):
    __slots__ = ("header", "step", "time", "nodes", "x", "v", "cut")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    TIME_FIELD_NUMBER: _ClassVar[int]
    NODES_FIELD_NUMBER: _ClassVar[int]
    X_FIELD_NUMBER: _ClassVar[int]
    V_FIELD_NUMBER: _ClassVar[int]
    CUT_FIELD_NUMBER: _ClassVar[int]
    header: Header
    step: int
    time: float
    nodes: int
    x: bytes
    v: bytes
    cut: int
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., step: _Optional[int] = ..., time: _Optional[float] = ..., nodes: _Optional[int] = ..., x: _Optional[bytes] = ..., v: _Optional[bytes] = ..., cut: _Optional[int] = ...) -> None: ...

class Vector(_message.Message):
    __slots__ = ("x", "y", "z")
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    x: float
    y: float
    z: float
    def __init__(self, x: _Optional[float] = ..., y: _Optional[float] = ..., z: _Optional[float] = ...) -> None: ...

class Quaternion(_message.Message):
    __slots__ = ("w", "x", "y", "z")
    W_FIELD_NUMBER: _ClassVar[int]
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    w: float
    x: float
    y: float
    z: float
    def __init__(self, w: _Optional[float] = ..., x: _Optional[float] = ..., y: _Optional[float] = ..., z: _Optional[float] = ...) -> None: ...

class Reaction(_message.Message):
    __slots__ = ("obstacle", "object", "grab", "force", "torque", "point")
    OBSTACLE_FIELD_NUMBER: _ClassVar[int]
    OBJECT_FIELD_NUMBER: _ClassVar[int]
    GRAB_FIELD_NUMBER: _ClassVar[int]
    FORCE_FIELD_NUMBER: _ClassVar[int]
    TORQUE_FIELD_NUMBER: _ClassVar[int]
    POINT_FIELD_NUMBER: _ClassVar[int]
    obstacle: str
    object: str
    grab: int
    force: Vector
    torque: Vector
    point: Vector
    def __init__(self, obstacle: _Optional[str] = ..., object: _Optional[str] = ..., grab: _Optional[int] = ..., force: _Optional[_Union[Vector, _Mapping]] = ..., torque: _Optional[_Union[Vector, _Mapping]] = ..., point: _Optional[_Union[Vector, _Mapping]] = ...) -> None: ...

class Reading(_message.Message):
    __slots__ = ("of", "quantity", "unit", "value")
    OF_FIELD_NUMBER: _ClassVar[int]
    QUANTITY_FIELD_NUMBER: _ClassVar[int]
    UNIT_FIELD_NUMBER: _ClassVar[int]
    VALUE_FIELD_NUMBER: _ClassVar[int]
    of: str
    quantity: str
    unit: str
    value: float
    def __init__(self, of: _Optional[str] = ..., quantity: _Optional[str] = ..., unit: _Optional[str] = ..., value: _Optional[float] = ...) -> None: ...

class Obstacle(_message.Message):
    __slots__ = ("header", "shape", "size", "vertices", "triangles", "moved", "position", "rotation")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    SHAPE_FIELD_NUMBER: _ClassVar[int]
    SIZE_FIELD_NUMBER: _ClassVar[int]
    VERTICES_FIELD_NUMBER: _ClassVar[int]
    TRIANGLES_FIELD_NUMBER: _ClassVar[int]
    MOVED_FIELD_NUMBER: _ClassVar[int]
    POSITION_FIELD_NUMBER: _ClassVar[int]
    ROTATION_FIELD_NUMBER: _ClassVar[int]
    header: Header
    shape: str
    size: _containers.RepeatedScalarFieldContainer[float]
    vertices: bytes
    triangles: bytes
    moved: str
    position: Vector
    rotation: Quaternion
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., shape: _Optional[str] = ..., size: _Optional[_Iterable[float]] = ..., vertices: _Optional[bytes] = ..., triangles: _Optional[bytes] = ..., moved: _Optional[str] = ..., position: _Optional[_Union[Vector, _Mapping]] = ..., rotation: _Optional[_Union[Quaternion, _Mapping]] = ...) -> None: ...

class ObstaclePose(_message.Message):
    __slots__ = ("header", "step", "time", "position", "rotation")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    TIME_FIELD_NUMBER: _ClassVar[int]
    POSITION_FIELD_NUMBER: _ClassVar[int]
    ROTATION_FIELD_NUMBER: _ClassVar[int]
    header: Header
    step: int
    time: float
    position: Vector
    rotation: Quaternion
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., step: _Optional[int] = ..., time: _Optional[float] = ..., position: _Optional[_Union[Vector, _Mapping]] = ..., rotation: _Optional[_Union[Quaternion, _Mapping]] = ...) -> None: ...

class ObstacleTarget(_message.Message):
    __slots__ = ("obstacle", "position", "rotation")
    OBSTACLE_FIELD_NUMBER: _ClassVar[int]
    POSITION_FIELD_NUMBER: _ClassVar[int]
    ROTATION_FIELD_NUMBER: _ClassVar[int]
    obstacle: str
    position: Vector
    rotation: Quaternion
    def __init__(self, obstacle: _Optional[str] = ..., position: _Optional[_Union[Vector, _Mapping]] = ..., rotation: _Optional[_Union[Quaternion, _Mapping]] = ...) -> None: ...

class ObstacleTargets(_message.Message):
    __slots__ = ("header", "step", "targets")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    TARGETS_FIELD_NUMBER: _ClassVar[int]
    header: Header
    step: int
    targets: _containers.RepeatedCompositeFieldContainer[ObstacleTarget]
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., step: _Optional[int] = ..., targets: _Optional[_Iterable[_Union[ObstacleTarget, _Mapping]]] = ...) -> None: ...

class Interaction(_message.Message):
    __slots__ = ("id", "client", "object", "kind", "point", "radius", "force", "duration", "target", "stiffness", "max_force", "nodes", "start", "held", "offsets", "at")
    ID_FIELD_NUMBER: _ClassVar[int]
    CLIENT_FIELD_NUMBER: _ClassVar[int]
    OBJECT_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    POINT_FIELD_NUMBER: _ClassVar[int]
    RADIUS_FIELD_NUMBER: _ClassVar[int]
    FORCE_FIELD_NUMBER: _ClassVar[int]
    DURATION_FIELD_NUMBER: _ClassVar[int]
    TARGET_FIELD_NUMBER: _ClassVar[int]
    STIFFNESS_FIELD_NUMBER: _ClassVar[int]
    MAX_FORCE_FIELD_NUMBER: _ClassVar[int]
    NODES_FIELD_NUMBER: _ClassVar[int]
    START_FIELD_NUMBER: _ClassVar[int]
    HELD_FIELD_NUMBER: _ClassVar[int]
    OFFSETS_FIELD_NUMBER: _ClassVar[int]
    AT_FIELD_NUMBER: _ClassVar[int]
    id: int
    client: str
    object: str
    kind: str
    point: Vector
    radius: float
    force: Vector
    duration: float
    target: Vector
    stiffness: float
    max_force: float
    nodes: int
    start: float
    held: bytes
    offsets: bytes
    at: str
    def __init__(self, id: _Optional[int] = ..., client: _Optional[str] = ..., object: _Optional[str] = ..., kind: _Optional[str] = ..., point: _Optional[_Union[Vector, _Mapping]] = ..., radius: _Optional[float] = ..., force: _Optional[_Union[Vector, _Mapping]] = ..., duration: _Optional[float] = ..., target: _Optional[_Union[Vector, _Mapping]] = ..., stiffness: _Optional[float] = ..., max_force: _Optional[float] = ..., nodes: _Optional[int] = ..., start: _Optional[float] = ..., held: _Optional[bytes] = ..., offsets: _Optional[bytes] = ..., at: _Optional[str] = ...) -> None: ...

class TouchSet(_message.Message):
    __slots__ = ("header", "step", "interactions")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    INTERACTIONS_FIELD_NUMBER: _ClassVar[int]
    header: Header
    step: int
    interactions: _containers.RepeatedCompositeFieldContainer[Interaction]
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., step: _Optional[int] = ..., interactions: _Optional[_Iterable[_Union[Interaction, _Mapping]]] = ...) -> None: ...

class FactorUse(_message.Message):
    __slots__ = ("header", "step", "pattern", "checksum", "dtype", "worker", "library", "threads", "seconds", "remedy", "method", "ahead", "later")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    PATTERN_FIELD_NUMBER: _ClassVar[int]
    CHECKSUM_FIELD_NUMBER: _ClassVar[int]
    DTYPE_FIELD_NUMBER: _ClassVar[int]
    WORKER_FIELD_NUMBER: _ClassVar[int]
    LIBRARY_FIELD_NUMBER: _ClassVar[int]
    THREADS_FIELD_NUMBER: _ClassVar[int]
    SECONDS_FIELD_NUMBER: _ClassVar[int]
    REMEDY_FIELD_NUMBER: _ClassVar[int]
    METHOD_FIELD_NUMBER: _ClassVar[int]
    AHEAD_FIELD_NUMBER: _ClassVar[int]
    LATER_FIELD_NUMBER: _ClassVar[int]
    header: Header
    step: int
    pattern: int
    checksum: int
    dtype: str
    worker: str
    library: str
    threads: int
    seconds: float
    remedy: str
    method: str
    ahead: float
    later: bool
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., step: _Optional[int] = ..., pattern: _Optional[int] = ..., checksum: _Optional[int] = ..., dtype: _Optional[str] = ..., worker: _Optional[str] = ..., library: _Optional[str] = ..., threads: _Optional[int] = ..., seconds: _Optional[float] = ..., remedy: _Optional[str] = ..., method: _Optional[str] = ..., ahead: _Optional[float] = ..., later: _Optional[bool] = ...) -> None: ...

class Cut(_message.Message):
    __slots__ = ("object", "blade", "center", "radius", "where", "elements", "split")
    OBJECT_FIELD_NUMBER: _ClassVar[int]
    BLADE_FIELD_NUMBER: _ClassVar[int]
    CENTER_FIELD_NUMBER: _ClassVar[int]
    RADIUS_FIELD_NUMBER: _ClassVar[int]
    WHERE_FIELD_NUMBER: _ClassVar[int]
    ELEMENTS_FIELD_NUMBER: _ClassVar[int]
    SPLIT_FIELD_NUMBER: _ClassVar[int]
    object: str
    blade: _containers.RepeatedCompositeFieldContainer[Vector]
    center: Vector
    radius: float
    where: str
    elements: str
    split: bool
    def __init__(self, object: _Optional[str] = ..., blade: _Optional[_Iterable[_Union[Vector, _Mapping]]] = ..., center: _Optional[_Union[Vector, _Mapping]] = ..., radius: _Optional[float] = ..., where: _Optional[str] = ..., elements: _Optional[str] = ..., split: _Optional[bool] = ...) -> None: ...

class Command(_message.Message):
    __slots__ = ("header", "client", "verb", "interaction", "secret", "target", "parameters", "object", "steps", "worker", "cut")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    CLIENT_FIELD_NUMBER: _ClassVar[int]
    VERB_FIELD_NUMBER: _ClassVar[int]
    INTERACTION_FIELD_NUMBER: _ClassVar[int]
    SECRET_FIELD_NUMBER: _ClassVar[int]
    TARGET_FIELD_NUMBER: _ClassVar[int]
    PARAMETERS_FIELD_NUMBER: _ClassVar[int]
    OBJECT_FIELD_NUMBER: _ClassVar[int]
    STEPS_FIELD_NUMBER: _ClassVar[int]
    WORKER_FIELD_NUMBER: _ClassVar[int]
    CUT_FIELD_NUMBER: _ClassVar[int]
    header: Header
    client: str
    verb: str
    interaction: Interaction
    secret: bytes
    target: ObstacleTarget
    parameters: _containers.RepeatedCompositeFieldContainer[Parameter]
    object: str
    steps: int
    worker: str
    cut: Cut
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., client: _Optional[str] = ..., verb: _Optional[str] = ..., interaction: _Optional[_Union[Interaction, _Mapping]] = ..., secret: _Optional[bytes] = ..., target: _Optional[_Union[ObstacleTarget, _Mapping]] = ..., parameters: _Optional[_Iterable[_Union[Parameter, _Mapping]]] = ..., object: _Optional[str] = ..., steps: _Optional[int] = ..., worker: _Optional[str] = ..., cut: _Optional[_Union[Cut, _Mapping]] = ...) -> None: ...

class Reply(_message.Message):
    __slots__ = ("header", "error", "interaction", "status", "unchanged", "parameters", "worker", "removed", "left", "opened", "copied", "role", "verbs")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    ERROR_FIELD_NUMBER: _ClassVar[int]
    INTERACTION_FIELD_NUMBER: _ClassVar[int]
    STATUS_FIELD_NUMBER: _ClassVar[int]
    UNCHANGED_FIELD_NUMBER: _ClassVar[int]
    PARAMETERS_FIELD_NUMBER: _ClassVar[int]
    WORKER_FIELD_NUMBER: _ClassVar[int]
    REMOVED_FIELD_NUMBER: _ClassVar[int]
    LEFT_FIELD_NUMBER: _ClassVar[int]
    OPENED_FIELD_NUMBER: _ClassVar[int]
    COPIED_FIELD_NUMBER: _ClassVar[int]
    ROLE_FIELD_NUMBER: _ClassVar[int]
    VERBS_FIELD_NUMBER: _ClassVar[int]
    header: Header
    error: str
    interaction: Interaction
    status: Status
    unchanged: bool
    parameters: _containers.RepeatedCompositeFieldContainer[LiveParameter]
    worker: str
    removed: int
    left: int
    opened: int
    copied: int
    role: str
    verbs: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., error: _Optional[str] = ..., interaction: _Optional[_Union[Interaction, _Mapping]] = ..., status: _Optional[_Union[Status, _Mapping]] = ..., unchanged: _Optional[bool] = ..., parameters: _Optional[_Iterable[_Union[LiveParameter, _Mapping]]] = ..., worker: _Optional[str] = ..., removed: _Optional[int] = ..., left: _Optional[int] = ..., opened: _Optional[int] = ..., copied: _Optional[int] = ..., role: _Optional[str] = ..., verbs: _Optional[_Iterable[str]] = ...) -> None: ...

class Parameter(_message.Message):
    __slots__ = ("key", "value")
    KEY_FIELD_NUMBER: _ClassVar[int]
    VALUE_FIELD_NUMBER: _ClassVar[int]
    key: str
    value: str
    def __init__(self, key: _Optional[str] = ..., value: _Optional[str] = ...) -> None: ...

class LiveParameter(_message.Message):
    __slots__ = ("now", "unit", "low", "high", "logarithmic", "about")
    NOW_FIELD_NUMBER: _ClassVar[int]
    UNIT_FIELD_NUMBER: _ClassVar[int]
    LOW_FIELD_NUMBER: _ClassVar[int]
    HIGH_FIELD_NUMBER: _ClassVar[int]
    LOGARITHMIC_FIELD_NUMBER: _ClassVar[int]
    ABOUT_FIELD_NUMBER: _ClassVar[int]
    now: Parameter
    unit: str
    low: float
    high: float
    logarithmic: bool
    about: str
    def __init__(self, now: _Optional[_Union[Parameter, _Mapping]] = ..., unit: _Optional[str] = ..., low: _Optional[float] = ..., high: _Optional[float] = ..., logarithmic: _Optional[bool] = ..., about: _Optional[str] = ...) -> None: ...

class ParameterSet(_message.Message):
    __slots__ = ("header", "step", "parameters", "client")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    PARAMETERS_FIELD_NUMBER: _ClassVar[int]
    CLIENT_FIELD_NUMBER: _ClassVar[int]
    header: Header
    step: int
    parameters: _containers.RepeatedCompositeFieldContainer[Parameter]
    client: str
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., step: _Optional[int] = ..., parameters: _Optional[_Iterable[_Union[Parameter, _Mapping]]] = ..., client: _Optional[str] = ...) -> None: ...

class Reset(_message.Message):
    __slots__ = ("header", "step")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    header: Header
    step: int
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., step: _Optional[int] = ...) -> None: ...

class Checkpoint(_message.Message):
    __slots__ = ("header", "step", "data")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    header: Header
    step: int
    data: bytes
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., step: _Optional[int] = ..., data: _Optional[bytes] = ...) -> None: ...

class EventCount(_message.Message):
    __slots__ = ("event", "steps")
    EVENT_FIELD_NUMBER: _ClassVar[int]
    STEPS_FIELD_NUMBER: _ClassVar[int]
    event: str
    steps: int
    def __init__(self, event: _Optional[str] = ..., steps: _Optional[int] = ...) -> None: ...

class ObjectStatus(_message.Message):
    __slots__ = ("object", "nodes", "tets", "last", "mean_iterations", "excess", "factors_used", "factors_refused", "in_flight", "factor_age", "factor_age_max", "factor_age_bound", "factors_mended", "refusal", "low", "high", "tip", "runaway_steps", "total_energy", "clipped", "events", "crowded")
    OBJECT_FIELD_NUMBER: _ClassVar[int]
    NODES_FIELD_NUMBER: _ClassVar[int]
    TETS_FIELD_NUMBER: _ClassVar[int]
    LAST_FIELD_NUMBER: _ClassVar[int]
    MEAN_ITERATIONS_FIELD_NUMBER: _ClassVar[int]
    EXCESS_FIELD_NUMBER: _ClassVar[int]
    FACTORS_USED_FIELD_NUMBER: _ClassVar[int]
    FACTORS_REFUSED_FIELD_NUMBER: _ClassVar[int]
    IN_FLIGHT_FIELD_NUMBER: _ClassVar[int]
    FACTOR_AGE_FIELD_NUMBER: _ClassVar[int]
    FACTOR_AGE_MAX_FIELD_NUMBER: _ClassVar[int]
    FACTOR_AGE_BOUND_FIELD_NUMBER: _ClassVar[int]
    FACTORS_MENDED_FIELD_NUMBER: _ClassVar[int]
    REFUSAL_FIELD_NUMBER: _ClassVar[int]
    LOW_FIELD_NUMBER: _ClassVar[int]
    HIGH_FIELD_NUMBER: _ClassVar[int]
    TIP_FIELD_NUMBER: _ClassVar[int]
    RUNAWAY_STEPS_FIELD_NUMBER: _ClassVar[int]
    TOTAL_ENERGY_FIELD_NUMBER: _ClassVar[int]
    CLIPPED_FIELD_NUMBER: _ClassVar[int]
    EVENTS_FIELD_NUMBER: _ClassVar[int]
    CROWDED_FIELD_NUMBER: _ClassVar[int]
    object: str
    nodes: int
    tets: int
    last: ObjectStep
    mean_iterations: float
    excess: float
    factors_used: int
    factors_refused: int
    in_flight: bool
    factor_age: int
    factor_age_max: int
    factor_age_bound: int
    factors_mended: int
    refusal: str
    low: Vector
    high: Vector
    tip: Vector
    runaway_steps: int
    total_energy: float
    clipped: int
    events: _containers.RepeatedCompositeFieldContainer[EventCount]
    crowded: int
    def __init__(self, object: _Optional[str] = ..., nodes: _Optional[int] = ..., tets: _Optional[int] = ..., last: _Optional[_Union[ObjectStep, _Mapping]] = ..., mean_iterations: _Optional[float] = ..., excess: _Optional[float] = ..., factors_used: _Optional[int] = ..., factors_refused: _Optional[int] = ..., in_flight: _Optional[bool] = ..., factor_age: _Optional[int] = ..., factor_age_max: _Optional[int] = ..., factor_age_bound: _Optional[int] = ..., factors_mended: _Optional[int] = ..., refusal: _Optional[str] = ..., low: _Optional[_Union[Vector, _Mapping]] = ..., high: _Optional[_Union[Vector, _Mapping]] = ..., tip: _Optional[_Union[Vector, _Mapping]] = ..., runaway_steps: _Optional[int] = ..., total_energy: _Optional[float] = ..., clipped: _Optional[int] = ..., events: _Optional[_Iterable[_Union[EventCount, _Mapping]]] = ..., crowded: _Optional[int] = ...) -> None: ...

class LocalWorker(_message.Message):
    __slots__ = ("worker", "state", "pid", "restarts", "exit_code")
    WORKER_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    PID_FIELD_NUMBER: _ClassVar[int]
    RESTARTS_FIELD_NUMBER: _ClassVar[int]
    EXIT_CODE_FIELD_NUMBER: _ClassVar[int]
    worker: str
    state: str
    pid: int
    restarts: int
    exit_code: int
    def __init__(self, worker: _Optional[str] = ..., state: _Optional[str] = ..., pid: _Optional[int] = ..., restarts: _Optional[int] = ..., exit_code: _Optional[int] = ...) -> None: ...

class Status(_message.Message):
    __slots__ = ("header", "scene", "state", "step", "time", "dt", "step_p50", "step_p99", "step_max", "late_steps", "objects", "workers", "clients", "bulk_shared", "bulk_copied", "bulk_on_device", "refused", "frames_dropped", "device", "pid", "uptime", "records_dropped", "records_thinned", "records_lost", "recording_failure", "commands_refused", "moves_replaced", "bulk_bytes_out", "bulk_bytes_in", "local_workers", "obstacles", "pace")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    SCENE_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    TIME_FIELD_NUMBER: _ClassVar[int]
    DT_FIELD_NUMBER: _ClassVar[int]
    STEP_P50_FIELD_NUMBER: _ClassVar[int]
    STEP_P99_FIELD_NUMBER: _ClassVar[int]
    STEP_MAX_FIELD_NUMBER: _ClassVar[int]
    LATE_STEPS_FIELD_NUMBER: _ClassVar[int]
    OBJECTS_FIELD_NUMBER: _ClassVar[int]
    WORKERS_FIELD_NUMBER: _ClassVar[int]
    CLIENTS_FIELD_NUMBER: _ClassVar[int]
    BULK_SHARED_FIELD_NUMBER: _ClassVar[int]
    BULK_COPIED_FIELD_NUMBER: _ClassVar[int]
    BULK_ON_DEVICE_FIELD_NUMBER: _ClassVar[int]
    REFUSED_FIELD_NUMBER: _ClassVar[int]
    FRAMES_DROPPED_FIELD_NUMBER: _ClassVar[int]
    DEVICE_FIELD_NUMBER: _ClassVar[int]
    PID_FIELD_NUMBER: _ClassVar[int]
    UPTIME_FIELD_NUMBER: _ClassVar[int]
    RECORDS_DROPPED_FIELD_NUMBER: _ClassVar[int]
    RECORDS_THINNED_FIELD_NUMBER: _ClassVar[int]
    RECORDS_LOST_FIELD_NUMBER: _ClassVar[int]
    RECORDING_FAILURE_FIELD_NUMBER: _ClassVar[int]
    COMMANDS_REFUSED_FIELD_NUMBER: _ClassVar[int]
    MOVES_REPLACED_FIELD_NUMBER: _ClassVar[int]
    BULK_BYTES_OUT_FIELD_NUMBER: _ClassVar[int]
    BULK_BYTES_IN_FIELD_NUMBER: _ClassVar[int]
    LOCAL_WORKERS_FIELD_NUMBER: _ClassVar[int]
    OBSTACLES_FIELD_NUMBER: _ClassVar[int]
    PACE_FIELD_NUMBER: _ClassVar[int]
    header: Header
    scene: str
    state: str
    step: int
    time: float
    dt: float
    step_p50: float
    step_p99: float
    step_max: float
    late_steps: int
    objects: _containers.RepeatedCompositeFieldContainer[ObjectStatus]
    workers: _containers.RepeatedCompositeFieldContainer[WorkerInfo]
    clients: _containers.RepeatedScalarFieldContainer[str]
    bulk_shared: int
    bulk_copied: int
    bulk_on_device: int
    refused: int
    frames_dropped: int
    device: str
    pid: int
    uptime: float
    records_dropped: int
    records_thinned: int
    records_lost: int
    recording_failure: str
    commands_refused: int
    moves_replaced: int
    bulk_bytes_out: int
    bulk_bytes_in: int
    local_workers: _containers.RepeatedCompositeFieldContainer[LocalWorker]
    obstacles: _containers.RepeatedCompositeFieldContainer[ObstaclePose]
    pace: str
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., scene: _Optional[str] = ..., state: _Optional[str] = ..., step: _Optional[int] = ..., time: _Optional[float] = ..., dt: _Optional[float] = ..., step_p50: _Optional[float] = ..., step_p99: _Optional[float] = ..., step_max: _Optional[float] = ..., late_steps: _Optional[int] = ..., objects: _Optional[_Iterable[_Union[ObjectStatus, _Mapping]]] = ..., workers: _Optional[_Iterable[_Union[WorkerInfo, _Mapping]]] = ..., clients: _Optional[_Iterable[str]] = ..., bulk_shared: _Optional[int] = ..., bulk_copied: _Optional[int] = ..., bulk_on_device: _Optional[int] = ..., refused: _Optional[int] = ..., frames_dropped: _Optional[int] = ..., device: _Optional[str] = ..., pid: _Optional[int] = ..., uptime: _Optional[float] = ..., records_dropped: _Optional[int] = ..., records_thinned: _Optional[int] = ..., records_lost: _Optional[int] = ..., recording_failure: _Optional[str] = ..., commands_refused: _Optional[int] = ..., moves_replaced: _Optional[int] = ..., bulk_bytes_out: _Optional[int] = ..., bulk_bytes_in: _Optional[int] = ..., local_workers: _Optional[_Iterable[_Union[LocalWorker, _Mapping]]] = ..., obstacles: _Optional[_Iterable[_Union[ObstaclePose, _Mapping]]] = ..., pace: _Optional[str] = ...) -> None: ...
