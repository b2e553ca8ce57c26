# SPDX-License-Identifier: MIT
"""Checks a factor before it is used: one application to a fixed vector, beside the steps.

With z = P^-1 r the first iteration of conjugate gradients takes (z.r)^2 / (z.Az) off e.Ae, the energy of the error
(Saad, Iterative Methods for Sparse Linear Systems, 2nd edition, 5.3.1), whatever scale P has. An exact factor takes off
all of it; a factor that takes off less than block Jacobi does is worth less than what costs nothing.
"""

import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.factor import Factor, FactorPattern
from protocol.shared_memory.located import Located, address, addresses
from sim_server.arrays import Int32
from sim_server.backends.factors_together import FactorsTogether
from sim_server.updates.checked_body import FACTOR, WORK, CheckedBodies, CheckedBody, library, sharing_threads
from sim_server.updates.patterns import Patterns

Reals = NDArray[np.float64]
MAX_RESIDUAL = 0.05  # |r - A P^-1 r| / |r| of a factor that is to take the place of A; exact ones in float32 have 1e-3
WITH_FACTOR, WITH_BLOCK_JACOBI = 1, 2  # parts of a judgement (factor_check.cpp)
NO_VALUES = np.zeros(1, np.float32)
MIN_SHARE = 0.9  # of what block Jacobi takes off, for a factor to be used; not 1, as one vector is not the space


class Probe(NamedTuple):
    """What an application z = P^-1 r shows; without a matrix only z.r.

    zr: z.r
    reduction, block_jacobi: (z.r)^2 / z.Az, the energy that an iteration takes off with the factor and with block
        Jacobi (0 if A is not positive definite)
    residual: |r - A z| / |r|
    """

    zr: float
    reduction: float
    block_jacobi: float
    residual: float


def _within_limits(zr: Any, reduction: Any, block_jacobi: Any, residual: Any) -> tuple[Any, Any, Any]:
    """Returns whether a Probe, or columns of it, show a positive definite factor, one that is no worse than block
    Jacobi, and one of its very matrix; False where a number is not one."""
    return (zr > 0) & (zr < np.inf), reduction >= MIN_SHARE * block_jacobi, residual <= MAX_RESIDUAL


class Checked(NamedTuple):
    """Factors that are checked, by columns. matrices: values (blocks, 3, 3) that each was made from; None: not known"""

    bodies: CheckedBodies
    values: Sequence[NDArray[Any]]
    matrices: Sequence[Reals | None]


class FactorCheck:
    """Checks factors of some objects.

    patterns: row_start and columns of A by object, nodes numbered from 0, or those of all epochs
    alone: factors are to take the place of A, so they must be exact
    """

    def __init__(
        self, patterns: Patterns | Mapping[str, tuple[NDArray[np.int32], NDArray[np.int32]]], alone: bool = False
    ):
        self._patterns, self._alone = patterns if isinstance(patterns, Patterns) else Patterns(patterns), alone
        self._vectors: dict[int, Reals] = {}  # probe vectors by size
        self._work = np.empty(0)
        self._working = threading.Lock()  # of this memory
        self._bodies: dict[str, CheckedBody] = {}  # by object
        self._columns = np.zeros((64, 5), np.uintp)  # of these, by row
        self._lock = threading.Lock()  # of these

    def prepare(self) -> None:
        """Compiles the native check, so that the first factor does not wait for it."""
        library()

    def vector(self, name: str, epoch: int) -> Reals:
        """Returns the probe vector r of an object, for who applies a factor in place of this check."""
        return self._vector(3 * (len(self._patterns.at(name, epoch)[0]) - 1))

    def reject_reasons(
        self, checked: Sequence[tuple[Factor, Reals | None]], applied: Callable[[], Reals | None] | None = None
    ) -> list[str]:  # fmt: skip
        """Returns why each of some factors is not to be used; empty if it is. From any thread: native code is called
        without Python's lock, once, or twice if somebody applies the factor.

        checked: factors, each with the values (blocks, 3, 3) that it was made from; None: not known, and the test
            against block Jacobi is left out
        applied: returns z = P^-1 r of the one factor, once who applies it beside this has it; None: nobody has
        """
        reasons = [self.wrong_size(factor) for factor, _ in checked]
        fitting = [k for k, reason in enumerate(reasons) if not reason]
        if not fitting:
            return reasons
        found = self._judged([checked[k] for k in fitting], applied)
        for k in np.flatnonzero(self._may_be_useless(found)).tolist():
            factor, matrix = checked[fitting[k]]
            reasons[fitting[k]] = self._useless(factor, matrix is not None, Probe(*found[k].tolist()))
        return reasons

    def bodies(
        self, objects: Sequence[str], epochs: Sequence[int], patterns: Sequence[FactorPattern]
    ) -> CheckedBodies | None:  # fmt: skip
        """Returns what native code needs to check factors of some objects, each of a pattern; None if one of them is
        not of the size of its object. From any thread."""
        known, at, same = self._bodies, self._patterns.at, not self._patterns.change
        found: list[CheckedBody] = []
        added = False
        with self._lock:
            for name, epoch, pattern in zip(objects, epochs, patterns, strict=True):
                body = known.get(name)
                if body is None or body.pattern is not pattern or not (same or body.fits(*at(name, epoch), pattern)):
                    row_start, columns = at(name, epoch)
                    if pattern.size != 3 * (len(row_start) - 1):
                        return None
                    body, added = self._added(name, row_start, columns, pattern), True
                found.append(body)
            rows = [body.row for body in found]
            native = np.array([body.native for body in found], np.uintp) if added else self._columns[rows]
            return CheckedBodies(native, found)

    def _added(self, name: str, row_start: Int32, columns: Int32, pattern: FactorPattern) -> CheckedBody:
        """Adds what is known of an object, in place of what was. With the lock."""
        last = self._bodies.get(name)
        body = CheckedBody(
            row_start, columns, self._vector(3 * (len(row_start) - 1)), pattern,
            len(self._bodies) if last is None else last.row,
        )  # fmt: skip
        self._bodies[name] = body
        if body.row == len(self._columns):
            self._columns = np.concatenate([self._columns, np.zeros_like(self._columns)])
        self._columns[body.row] = body.native
        return body

    def reject_together(self, factors: FactorsTogether, matrices: Sequence[Reals | None]) -> list[str]:
        """Returns what `reject_reasons` does, of factors that came together. matrices: that they were made from"""
        bodies = self.bodies(factors.objects, factors.epochs, [factors.pattern] * len(factors))
        if bodies is None:
            return self.reject_reasons(list(zip(factors, matrices, strict=True)))
        judged = self._judge(Checked(bodies, factors.values, matrices), WITH_FACTOR | WITH_BLOCK_JACOBI)
        return self.reasons(factors, judged, matrices)

    def reasons(
        self, factors: FactorsTogether, judged: Reals, matrices: Sequence[Reals | None] | None = None
    ) -> list[str]:  # fmt: skip
        """Returns why each of some factors is not to be used; empty if it is. judged: of each, as of wf_judge_all.
        matrices: that they were made from; None: all are known"""
        found, reasons = _probes(judged), [""] * len(factors)
        for k in np.flatnonzero(self._may_be_useless(found)).tolist():
            known = matrices is None or matrices[k] is not None
            reasons[k] = self._useless(factors[k], known, Probe(*found[k].tolist()))
        return reasons

    def wrong_size(self, factor: Factor) -> str:
        """Returns why a factor is not of the size of its object; empty if it is."""
        row_start, columns = self._patterns.at(factor.object, factor.epoch)
        known, count = self._bodies.get(factor.object), len(factor.values)
        if known is not None and known.fits(row_start, columns, factor.pattern) and count == known.nonzeros:
            return ""  # as of the factor before
        nodes = len(row_start) - 1
        if factor.pattern.size != 3 * nodes:
            return f"its size is {factor.pattern.size}, that of the object {3 * nodes}"
        if count != factor.pattern.nonzeros:
            return f"it has {count} values, its pattern {factor.pattern.nonzeros}"
        return ""

    def _may_be_useless(self, found: Reals) -> NDArray[np.bool_]:
        """Returns for which columns of Probe, (k, 4), `_useless` may have a reason: all others have none."""
        positive, better, exact = _within_limits(*found.T)
        useless: NDArray[np.bool_] = ~(positive & better & exact if self._alone else positive & better)
        return useless

    def _useless(self, factor: Factor, known: bool, probe: Probe) -> str:
        """known: its matrix is"""
        zr, reduction, block_jacobi, residual = probe
        positive, better, exact = _within_limits(*probe)
        if not positive:
            return f"not positive definite or not finite (z.r = {zr:.3g} on a probe vector)"
        if known and not better:
            return (
                "worse than block Jacobi on a probe vector: an iteration takes "
                f"{reduction:.3g} off the energy of the error, with block Jacobi {block_jacobi:.3g}"
            )
        if self._alone and known and not factor.remedy and not exact:
            return (
                f"not that of its matrix: it leaves {residual:.3g} of a residual, at most {MAX_RESIDUAL:g} is allowed"
            )
        return ""

    def probe(self, factor: Factor, matrix: Reals | None) -> Probe:
        """Applies a factor, which has the right size, to the probe vector r. From any thread."""
        return self.probe_all([(factor, matrix)])[0]

    def probe_all(
        self, checked: Sequence[tuple[Factor, Reals | None]], applied: Callable[[], Reals | None] | None = None
    ) -> list[Probe]:  # fmt: skip
        """Applies factors, each of which has the right size, to the probe vector r. From any thread. applied: as of
        `reject_reasons`"""
        return [Probe(*row) for row in self._judged(checked, applied).tolist()] if checked else []

    def _judged(
        self, checked: Sequence[tuple[Factor, Reals | None]], applied: Callable[[], Reals | None] | None
    ) -> Reals:  # fmt: skip
        """Returns the columns of Probe, (k, 4)."""
        factors, matrices = [factor for factor, _ in checked], [matrix for _, matrix in checked]
        objects, epochs = [f.object for f in factors], [f.epoch for f in factors]
        patterns, values = [f.pattern for f in factors], [f.values for f in factors]
        bodies = self.bodies(objects, epochs, patterns)
        if bodies is None:
            raise ValueError("a factor is not of the size of its object")
        given = Checked(bodies, values, matrices)
        if applied is None:
            return _probes(self._judge(given, WITH_FACTOR | WITH_BLOCK_JACOBI))
        unread = given._replace(values=[NO_VALUES] * len(values))  # those on a device would be copied
        out = self._judge(unread, WITH_BLOCK_JACOBI)  # meanwhile
        z = applied()
        return _probes(out + self._judge(given if z is None else unread, WITH_FACTOR, z))

    def _judge(self, checked: Checked, parts: int, applied: Reals | None = None) -> Reals:
        """Returns what wf_judge_all finds, (k, 5), 0 but for some parts. applied: P^-1 r of the only factor, whose
        values are not read then"""
        with self._working:
            return self._judge_alone(checked, parts, applied)

    def _judge_alone(self, checked: Checked, parts: int, applied: Reals | None) -> Reals:
        bodies, values, matrices = checked
        count, values = len(values), [_contiguous(each) for each in values]
        row_start, columns, r, pattern, sizes = bodies.columns.T.copy()
        factors, nodes = np.zeros(count, FACTOR), sizes.astype(np.int32)
        factors["pattern"], factors["values"] = pattern, addresses(values)
        factors["bytes"] = [each.itemsize for each in values]
        threads, room = sharing_threads(count), WORK * 3 * int(nodes.max())
        if threads * room > len(self._work):
            self._work = np.empty(threads * room)
        there = [k for k, matrix in enumerate(matrices) if matrix is not None]
        known = np.zeros(count, np.uintp)  # addresses of matrices
        known[there] = addresses([matrix for matrix in matrices if matrix is not None])
        z, out = np.full(count, 0 if applied is None else address(applied), np.uintp), np.zeros((count, 5))
        arrays = factors, nodes, row_start, columns, known, r, z, self._work, out
        library().wf_judge_all(count, parts, *map(address, arrays), room, threads)
        return out

    def _vector(self, size: int) -> Reals:
        if size not in self._vectors:
            self._vectors[size] = np.random.default_rng(0).standard_normal(size)
        return self._vectors[size]


def _probes(out: Reals) -> Reals:
    """Returns the columns of Probe, (k, 4), of what native code has found, (k, 5)."""
    za = np.where(out[:, 1:4:2] > 0, out[:, 1:4:2], np.inf)
    energy = out[:, 0:4:2] ** 2 / za
    return np.column_stack([out[:, 0], energy, out[:, 4]])


def _contiguous(values: NDArray[Any]) -> NDArray[Any]:
    return values if isinstance(values, Located) and values.flags.c_contiguous else np.ascontiguousarray(values)
