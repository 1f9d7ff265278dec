"""Linear problem of a test: blocks of rows of the fundamentals and of every other harmonic.

The blocks share only the laws. Each is orthogonalised once (QR) for all hypotheses.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int
from scipy.linalg import block_diag, cholesky, solve_triangular

from snrmjax.diagnose import priors
from snrmjax.diagnose.naming.columns import Column
from snrmjax.diagnose.readings import Readings

_KNOTS_A_UNIT = 8  # knots per unit of ln a
_MOST_KNOTS = 40
_NO_VARIANCE = 1e-8  # of the largest: functions of the remainder below it are left out

CURVES = "stiffness", "damping"
"""Parts that are curves of amplitude; the others are harmonics."""

RemainderStds = tuple[float, ...]
LevelStds = tuple[float, float, float, float]
"""1σ of level errors of gain, phase, stiffness and damping, over those estimated without laws."""
WITHOUT_LAWS: LevelStds = (1.0, 1.0, 1.0, 1.0)


class Cell(NamedTuple):
    """One hypothesis: some columns, with given standard deviations of the remainders."""

    log_evidence: float  # ln of evidence times prior
    columns: tuple[int, ...]  # indices in `Problem.columns`
    remainder_std: RemainderStds  # of stiffness, damping and every other harmonic
    level_std: LevelStds = WITHOUT_LAWS


class RowBlock(NamedTuple):
    """Rows with their own errors and remainders, and the QR decomposition of these."""

    rows: Float[np.ndarray, " row"]
    design: Float[np.ndarray, "row unknown"]  # errors, then remainder functions of unit variance
    groups: tuple[int, ...]  # numbers of errors, and of functions of every remainder
    levels: Int[np.ndarray, "kind level"]  # indices of the level errors
    directions: Float[np.ndarray, "row direction"]  # Q of the design
    triangle: Float[np.ndarray, "direction unknown"]
    laws: Float[np.ndarray, "row column"]
    along: Float[np.ndarray, "direction column"]  # Qᵀ times the laws and, last, the rows
    across: Float[np.ndarray, "column column"]  # Gram matrix of their parts orthogonal to Q

    @classmethod
    def of(
        cls,
        rows: Float[np.ndarray, " row"],
        errors: Float[np.ndarray, "row error"],
        *remainders: Float[np.ndarray, "row function"],
        levels: Int[np.ndarray, "kind level"] | None = None,
    ) -> "RowBlock":
        """A block without laws."""
        of_level = np.zeros((4, 0), int) if levels is None else levels
        design = np.hstack([errors, *remainders])
        groups = errors.shape[1], *(one.shape[1] for one in remainders)
        none = np.empty((0, 0))
        return cls(rows, design, groups, of_level, *np.linalg.qr(design), none, none, none)

    def with_laws(self, laws: Float[np.ndarray, "row column"]) -> "RowBlock":
        """The block with the columns of laws."""
        both = np.column_stack([laws, self.rows])
        along = self.directions.T @ both
        left = both - self.directions @ along
        return self._replace(laws=laws, along=along, across=left.T @ left)

    def variances(
        self, remainder_std: RemainderStds, level_std: LevelStds = WITHOUT_LAWS
    ) -> Float[np.ndarray, " unknown"]:
        """Prior variances of the design's unknowns."""
        values = np.repeat([1.0, *(std**2 for std in remainder_std)], self.groups)
        values[self.levels] = np.square(level_std)[:, None]
        return values


class Problem(NamedTuple):
    """All rows with their errors, laws and remainders."""

    readings: Readings
    columns: list[Column]
    functions: dict[str, Float[np.ndarray, "state function"]]  # of remainders of unit variance
    blocks: tuple[RowBlock, ...]  # fundamentals, then every other harmonic
    length: float  # correlation length in ln a of the remainders of stiffness and damping
    level_stds: tuple[tuple[LevelStds, float], ...] = ((WITHOUT_LAWS, 0.0),)  # with ln prior

    @property
    def parts(self) -> tuple[str, ...]:
        """The parts of the test that may have a remainder."""
        return tuple(self.functions)

    def with_columns(self, columns: list[Column]) -> "Problem":
        """The problem with other columns."""
        readings = self.readings
        unit = readings.natural_frequency**2
        laws = [readings.whitened(unit * np.array([column.change for column in columns])).T]
        for index, one in enumerate(readings.harmonics):
            higher = np.array([column.higher[index] for column in columns])
            laws.append(one.whitened(unit * higher).T)
        blocks = [block.with_laws(own) for block, own in zip(self.blocks, laws, strict=True)]
        return self._replace(columns=columns, blocks=tuple(blocks))

    def remainders(self, part: str, at: Float[np.ndarray, " point"]) -> np.ndarray:
        """A part's functions at amplitudes over the largest one."""
        of_curve = _of_curves if part in CURVES else _of_harmonic
        return of_curve(self.readings.relative_amplitude, at, self.length)


def problem_of(readings: Readings, columns: list[Column], length: float) -> Problem:
    """The linear problem, decomposed once for all hypotheses."""
    x, natural = readings.relative_amplitude, readings.natural_frequency
    functions = {part: _of_curves(x, x, length) for part in CURVES}
    curves = natural**2 * functions[CURVES[0]].T
    lossy = 1j * readings.relative_frequency * curves
    remainders = readings.whitened(curves).T, readings.whitened(lossy).T
    errors = readings.errors
    blocks = [RowBlock.of(readings.rows, errors, *remainders, levels=readings.levels)]
    for one in readings.harmonics:
        both = _of_harmonic(x, x, length)
        functions[f"harmonic_{one.order}"] = both
        own = one.whitened(natural**2 * both.T).T
        blocks.append(RowBlock.of(one.whitened(one.beyond), one.whitened(one.errors).T, own))
    return Problem(readings, [], functions, tuple(blocks), length).with_columns(columns)


def _of_curves(
    measured: Float[np.ndarray, " state"], at: Float[np.ndarray, " point"], length: float
) -> Float[np.ndarray, "point function"]:
    """Functions of stiffness or damping, less their means over the states.

    A constant belongs to the linear mode, whose errors and changes have their own columns.
    """
    constant = np.mean(_functions(measured, measured, length), axis=0)
    return _functions(measured, at, length) - constant


def _of_harmonic(
    measured: Float[np.ndarray, " state"], at: Float[np.ndarray, " point"], _: float
) -> Complex[np.ndarray, "point function"]:
    """Functions of the real and of the imaginary part of another harmonic."""
    functions = _functions(measured, at, min(priors.REMAINDER_LENGTHS))
    return np.hstack([functions, 1j * functions])


def _functions(
    measured: Float[np.ndarray, " state"], at: Float[np.ndarray, " point"], length: float
) -> Float[np.ndarray, "point function"]:
    """Basis functions whose sum with N(0, 1) weights is a Matérn 5/2 process in ln a."""
    low = float(np.log(np.min(measured)))
    knots = np.linspace(low, 0.0, int(min(_MOST_KNOTS, 8 - _KNOTS_A_UNIT * low)))
    values, vectors = np.linalg.eigh(_matern(knots, knots, length))
    kept = values > _NO_VARIANCE * values[-1]
    inside = np.clip(np.log(at), low, np.inf)
    return _matern(inside, knots, length) @ (vectors[:, kept] / np.sqrt(values[kept]))


def _matern(u: np.ndarray, v: np.ndarray, length: float) -> np.ndarray:
    r = np.sqrt(5.0) * np.abs(np.subtract.outer(u, v)) / length
    return (1 + r + r * r / 3) * np.exp(-r)


class Solved(NamedTuple):
    """Posterior mean and covariance of a hypothesis' strengths and remainders."""

    mean: Float[np.ndarray, " unknown"]  # strengths, then the remainders' functions, part by part
    covariance: Float[np.ndarray, "unknown unknown"]
    misfit: float  # rms residual of the rows
    of_fundamentals: float  # rms residual of the fundamentals' rows
    linear: tuple[float, float]  # errors of the natural frequency and damping ratio, in their 1σ


def solved(problem: Problem, cell: Cell) -> Solved:
    """Posterior of a hypothesis, with N(0, 1) priors of strengths and of errors.

    Block by block: errors and remainders are eliminated first, then the laws are solved for.
    """
    laws, blocks = list(cell.columns), problem.blocks
    first, *further = blocks
    own = first.variances(cell.remainder_std[:2], cell.level_std)
    others = zip(further, cell.remainder_std[2:], strict=True)
    eliminated = [_eliminated(first, own, laws)]
    eliminated += [_eliminated(block, block.variances((std,)), laws) for block, std in others]
    # Strengths of laws are far smaller than 1: a flat prior.
    precision = np.eye(len(laws)) + sum(one.precision for one in eliminated)
    of_laws = np.linalg.inv(precision)
    strengths = of_laws @ sum(one.force for one in eliminated)
    slopes = np.vstack([np.eye(len(laws)), *(-one.along_laws[one.remain] for one in eliminated)])
    unknowns = [one.mean - one.along_laws @ strengths for one in eliminated]
    mean = [unknown[one.remain] for one, unknown in zip(eliminated, unknowns, strict=True)]
    own_covariance = [one.covariance[np.ix_(one.remain, one.remain)] for one in eliminated]
    covariance = slopes @ of_laws @ slopes.T
    covariance += block_diag(np.zeros((len(laws), len(laws))), *own_covariance)
    left = [
        (block.rows - block.laws[:, laws] @ strengths - block.design @ unknown) ** 2
        for block, unknown in zip(blocks, unknowns, strict=True)
    ]
    return Solved(
        np.concatenate([strengths, *mean]),
        covariance,
        misfit=float(np.sqrt(np.mean(np.concatenate(left)))),
        of_fundamentals=float(np.sqrt(np.mean(left[0]))),
        linear=(float(unknowns[0][1]), float(unknowns[0][2])),  # after that of the modal mass
    )


class _Eliminated(NamedTuple):
    """Errors and remainders of a block for given laws, and what its rows say of the laws."""

    precision: Float[np.ndarray, "law law"]
    force: Float[np.ndarray, " law"]  # precision times strengths
    mean: Float[np.ndarray, " unknown"]  # without laws
    along_laws: Float[np.ndarray, "unknown law"]  # its decrease per strength
    covariance: Float[np.ndarray, "unknown unknown"]  # with known laws
    remain: Bool[np.ndarray, " unknown"]  # functions of the remainders


def _eliminated(block: RowBlock, variances: np.ndarray, laws: list[int]) -> _Eliminated:
    root, some = np.sqrt(variances), [*laws, -1]
    scaled = block.triangle * root
    across, along = block.across[np.ix_(some, some)], block.along[:, some]
    factor = cholesky(scaled @ scaled.T + np.eye(len(scaled)), lower=True)
    white = solve_triangular(factor, along, lower=True)
    gram = across + white.T @ white
    inverse = np.linalg.inv(scaled.T @ scaled + np.eye(len(root)))
    gain = root[:, None] * (scaled.T @ solve_triangular(factor, white, lower=True, trans=1))
    remain = np.repeat([False, True], [block.groups[0], sum(block.groups[1:])])
    covariance = root[:, None] * inverse * root
    return _Eliminated(gram[:-1, :-1], gram[:-1, -1], gain[:, -1], gain[:, :-1], covariance, remain)
