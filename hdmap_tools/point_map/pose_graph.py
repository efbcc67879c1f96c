"""The pose graph: what the given poses say, joined with what registration says.

Unknown is each pose's correction (shift and turn in city axes). The given poses'
errors are taken as a Gauss-Markov process: neighbours share most of their error, and
over long distances it wanders.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation

from hdmap_tools.geometry.se3 import Trajectory
from hdmap_tools.point_map.refine_config import RefineConfig
from hdmap_tools.types import NDArrayBool, NDArrayFloat, NDArrayInt

_MIN_CHANGES: Final = 20


@dataclass(frozen=True, eq=False)
class Correction:
    """What is changed of poses: ``R' = exp(turn) R``, ``t' = t + shift``, city axes.

    Attributes:
        shifts: (S, 3) metres.
        turns: (S, 3) rotation vectors, radians.
    """

    shifts: NDArrayFloat
    turns: NDArrayFloat

    @classmethod
    def none(cls, count: int) -> Correction:
        """For so many poses."""
        return cls(np.zeros((count, 3)), np.zeros((count, 3)))

    @property
    def vectors(self) -> NDArrayFloat:
        """(S, 6) shift, then turn."""
        return np.concatenate([self.shifts, self.turns], axis=1)

    def applied(
        self, rotations: NDArrayFloat, translations: NDArrayFloat
    ) -> tuple[NDArrayFloat, NDArrayFloat]:
        """The poses (S, 3, 3), (S, 3) changed."""
        return (
            Rotation.from_rotvec(self.turns).as_matrix() @ rotations,
            translations + self.shifts,
        )

    def plus(self, step: NDArrayFloat) -> Correction:
        """Changed further by (S, 6)."""
        turned = Rotation.from_rotvec(step[:, 3:]) * Rotation.from_rotvec(self.turns)
        return Correction(self.shifts + step[:, :3], turned.as_rotvec())

    def at(self, timestamps_ns: NDArrayInt, wanted_ns: NDArrayInt) -> Correction:
        """Interpolated from the times of these (S,) to others; outside, the nearest one's."""
        origin = timestamps_ns[0]
        knots, query = (timestamps_ns - origin) / 1e9, (wanted_ns - origin) / 1e9
        # Turns are fractions of a degree: interpolating their vectors is slerp to 1e-6 of them.
        columns = [np.interp(query, knots, column) for column in self.vectors.T]
        stacked = np.column_stack(columns)
        return Correction(stacked[:, :3], stacked[:, 3:])


@dataclass(frozen=True, eq=False)
class Prior:
    """Precision of a chain of corrections, whose mean is none.

    Attributes:
        own: (S, 6) diagonal of each pose's block.
        next: (S, 6) diagonal of the block between each pose and the next of its drive;
            zero at a drive's end.
        memory: (S, 6) share of a pose's error that the next one of its drive keeps.
        sigma: (S, 6) of what the next one adds; both mean nothing at a drive's end.
        offset_of: (S,) which offset each pose shares with its whole drive, or -1.
        offset_information: (D, 6) of each offset; the mean of a drive's chain is its offset.
    """

    own: NDArrayFloat
    next: NDArrayFloat
    memory: NDArrayFloat
    sigma: NDArrayFloat
    offset_of: NDArrayInt
    offset_information: NDArrayFloat

    def pull(self, vectors: NDArrayFloat) -> NDArrayFloat:
        """Gradient (S, 6) at corrections (S, 6), the offsets being the best for them."""
        rows, bindings, totals = self.bindings
        best = np.zeros_like(totals)
        np.add.at(best, self.offset_of[rows], bindings * vectors[rows])
        about = vectors.copy()
        about[rows] -= (best / totals)[self.offset_of[rows]]
        return self._times(about)

    @property
    def bindings(self) -> tuple[NDArrayInt, NDArrayFloat, NDArrayFloat]:
        """Poses (R,) that share an offset, their precision bound to it (R, 6), and its own (D, 6)."""
        rows = np.flatnonzero(self.offset_of >= 0)
        bound = self._times(np.ones_like(self.own))[rows]
        totals = self.offset_information.copy()
        np.add.at(totals, self.offset_of[rows], bound)
        return rows, bound, totals

    def _times(self, vectors: NDArrayFloat) -> NDArrayFloat:
        result: NDArrayFloat = self.own * vectors
        result[:-1] += self.next[:-1] * vectors[1:]
        result[1:] += self.next[:-1] * vectors[:-1]
        return result


def sigmas(config: RefineConfig) -> NDArrayFloat:
    """(6,) of one given pose, about its drift: metres, then radians."""
    return np.repeat([config.noise_m, np.deg2rad(config.noise_deg)], 3)


def drive_prior(
    trajectory: Trajectory,
    config: RefineConfig,
    *,
    is_reference: bool,
    scale: tuple[float, float] = (1.0, 1.0),
) -> Prior:
    """What is assumed of the errors of one drive's poses.

    Noise that forgets itself and drift that walks are joined into one Gauss-Markov
    process that changes between neighbours as much as both together.

    Args:
        trajectory: Given poses at the sweeps' times.
        config: Gives the sigmas.
        is_reference: Its place as a whole is believed; other drives are aligned to it.
        scale: Of noise and drift, in metres and in degrees, against those in `config`.
    """
    scales = np.repeat(scale, 3)
    seconds = np.diff(trajectory.timestamps_ns) / 1e9
    metres = np.linalg.norm(np.diff(trajectory.translations, axis=0), axis=1)
    noise = sigmas(config) * scales
    drift = np.repeat([config.drift_m, np.deg2rad(config.drift_deg)], 3) * scales
    forgotten = -np.expm1(-seconds / config.noise_correlation_s)
    change = 2 * noise**2 * forgotten[:, None] + drift**2 * metres[:, None] / 100.0
    spread = noise**2 + drift**2 * max(trajectory.length_m, 100.0) / 100.0
    memory = np.zeros((len(trajectory), 6))
    memory[:-1] = np.clip(1 - change / (2 * spread), 0.0, 1 - 1e-9)
    innovation = 1 / (spread * (1 - memory[:-1] ** 2))
    own = np.zeros_like(memory)
    own[0] = 1 / spread
    own[1:] += innovation
    own[:-1] += memory[:-1] ** 2 * innovation
    after = np.zeros_like(memory)
    after[:-1] = -memory[:-1] * innovation
    between = np.repeat([config.between_drives_m, np.deg2rad(config.between_drives_deg)], 3)
    return Prior(
        own,
        after,
        memory,
        np.sqrt(spread * (1 - memory**2)),
        offset_of=np.full(len(trajectory), -1 if is_reference else 0),
        offset_information=np.zeros((0, 6)) if is_reference else between[None] ** -2.0,
    )


def observed_scale(
    prior: Prior, correction: Correction, is_held: NDArrayBool
) -> tuple[float, float]:
    """How large the corrections of one drive change from pose to pose, against the prior.

    Poses better than assumed would else be made worse: registration has errors, too.

    Args:
        prior: Of that drive.
        correction: Found with it.
        is_held: (S, 6) which of each pose's directions the scene holds; the others
            were not corrected and say nothing.

    Returns:
        Factor of metres and of degrees; 1 where too little is held to say.
    """
    vectors = correction.vectors
    whitened = (vectors[1:] - prior.memory[:-1] * vectors[:-1]) / prior.sigma[:-1]
    usable = is_held[1:] & is_held[:-1]
    factors = []
    for part in (slice(0, 3), slice(3, 6)):
        values = np.abs(whitened[:, part][usable[:, part]])
        # The median, so that a few wild registrations do not count.
        is_enough = len(values) >= 3 * _MIN_CHANGES
        factors.append(float(np.median(values)) / 0.6745 if is_enough else 1.0)
    return factors[0], factors[1]


def joined_priors(priors: list[Prior]) -> Prior:
    """Of several drives, one after another."""
    firsts = np.cumsum([0] + [len(prior.offset_information) for prior in priors])
    return Prior(
        np.concatenate([prior.own for prior in priors]),
        np.concatenate([prior.next for prior in priors]),
        np.concatenate([prior.memory for prior in priors]),
        np.concatenate([prior.sigma for prior in priors]),
        offset_of=np.concatenate(
            [
                np.where(prior.offset_of >= 0, prior.offset_of + first, -1)
                for prior, first in zip(priors, firsts[:-1], strict=True)
            ]
        ),
        offset_information=np.concatenate([prior.offset_information for prior in priors]),
    )


def solve(
    prior: Prior,
    current: Correction,
    rows: NDArrayInt,
    columns: NDArrayInt,
    blocks: NDArrayFloat,
    gradient: NDArrayFloat,
    ties: NDArrayFloat | None = None,
) -> NDArrayFloat:
    """The step (S, 6) from the current corrections that prior and registration ask for.

    With `ties`, each pose has a double that registration acts on, and the two are
    bound together in the directions that the scene holds. In the others the double is
    free, so that registration says nothing there. Projecting those directions out of
    each pose's equations instead would not do: what a neighbour knows would then push
    the drive as a whole (34 cm in a trial), because a common shift no longer cancels.

    Args:
        prior: What the given poses say.
        current: Where the equations were made.
        rows: (B,) of the blocks, not above `columns`.
        columns: (B,).
        blocks: (B, 6, 6) upper half of the registration's information.
        gradient: (S, 6) of registration.
        ties: (S, 6, 6) information of the bond, or None where all is held.
    """
    from scipy.sparse import block_array, diags
    from scipy.sparse.linalg import splu

    count = len(gradient)
    registered = _symmetric(rows, columns, blocks, count)
    given, binding, offsets = _prior_matrices(prior)
    pull = prior.pull(current.vectors).ravel()
    # The offsets begin at their best for the current corrections: nothing pulls on them.
    rest = np.zeros(offsets.shape[0])
    if ties is None:
        blocks_of = [[given + registered, binding], [binding.T, offsets]]
        right = np.concatenate([pull + gradient.ravel(), rest])
    else:
        numbers = np.arange(count)
        tie = _symmetric(numbers, numbers, ties, count)
        blocks_of = [
            [given + tie, -tie, binding],
            [-tie, registered + tie, None],
            [binding.T, None, offsets],
        ]
        right = np.concatenate([pull, gradient.ravel(), rest])
    if len(rest) == 0:
        blocks_of = [row[:-1] for row in blocks_of[:-1]]
    matrix = block_array(blocks_of, format="csc")
    # Metres and radians in one scale, so that pivots on the diagonal are sound.
    scale = 1 / np.sqrt(matrix.diagonal())
    scaling = diags([scale], [0], format="csc")
    factor = splu(
        (scaling @ matrix @ scaling).tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    step: NDArrayFloat = -(scale * factor.solve(scale * right))
    return step[: 6 * count].reshape(-1, 6)


def _prior_matrices(prior: Prior) -> tuple[Any, Any, Any]:
    """Precision of the corrections (6 S, 6 S), with their offsets (6 S, 6 D), of those (6 D, 6 D)."""
    from scipy.sparse import coo_matrix, diags

    beside = prior.next.ravel()[:-6]
    own = diags([prior.own.ravel(), beside, beside], [0, 6, -6], format="csc")
    rows, bound, totals = prior.bindings
    inside = np.arange(6)
    binding = coo_matrix(
        (
            -bound.ravel(),
            (
                (6 * rows[:, None] + inside).ravel(),
                (6 * prior.offset_of[rows][:, None] + inside).ravel(),
            ),
        ),
        shape=(prior.own.size, totals.size),
    )
    return own, binding.tocsc(), diags([totals.ravel()], [0], format="csc")


def _symmetric(rows: NDArrayInt, columns: NDArrayInt, blocks: NDArrayFloat, count: int) -> Any:
    """A sparse (6 S, 6 S) matrix from blocks (B, 6, 6) of its upper half."""
    from scipy.sparse import coo_matrix

    inside = np.arange(6)
    at_row = np.broadcast_to(6 * rows[:, None, None] + inside[:, None], blocks.shape)
    at_column = np.broadcast_to(6 * columns[:, None, None] + inside, blocks.shape)
    is_off = rows != columns
    values = np.concatenate([blocks.ravel(), blocks[is_off].ravel()])
    at = (
        np.concatenate([at_row.ravel(), at_column[is_off].ravel()]),
        np.concatenate([at_column.ravel(), at_row[is_off].ravel()]),
    )
    return coo_matrix((values, at), shape=(6 * count, 6 * count)).tocsc()
