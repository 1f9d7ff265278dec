"""What every result can do: say itself on one screen, become a labelled data set, be drawn."""

import abc
import importlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import numpy as np

if TYPE_CHECKING:
    import matplotlib.figure
    import pandas
    import xarray

_drawing_module: str | None = None


class Variable(NamedTuple):
    """One quantity of a result, as a labelled data set holds it."""

    dimensions: tuple[str, ...]
    values: Any  # array of that many dimensions, numbers or text
    unit: str  # "Hz", "m/s", "1"; "" for text
    meaning: str  # a few words that an engineer reads beside the axis


class AbstractResult(eqx.Module):
    """Base of results: a repr of one screen, `to_xarray()`, `to_pandas()` and `plot()`.

    A result states its `summary()` (what, how many, range, status) and its `variables()`, named
    as the columns of the files are (`frequency_hz`, `velocity_m_s`); those in `coordinates`
    label the others.
    """

    coordinates: ClassVar[tuple[str, ...]] = ()

    @abc.abstractmethod
    def summary(self) -> tuple[str, ...]:
        """Lines of text: the first says what it is, the others how many, range and status."""

    @abc.abstractmethod
    def variables(self) -> Mapping[str, Variable]:
        """Quantities by name, in units of files (Hz, m/s)."""

    def attributes(self) -> Mapping[str, str | float | int]:
        """What holds for the whole result: settings, verdicts, notes."""
        return {}

    def __repr__(self) -> str:
        """The summary; within `jax.jit`, where nothing has a value yet, the fields' shapes."""
        valueless = (jax.core.Tracer, jax.ShapeDtypeStruct)
        if any(isinstance(leaf, valueless) for leaf in jax.tree.leaves(self)):
            return eqx.tree_pformat(self)
        first, *others = self.summary()
        return "\n".join([first, *(f"  {line}" for line in others)])

    def to_xarray(self) -> "xarray.Dataset":
        """The result as an `xarray.Dataset`, with a unit and a meaning on every variable."""
        import xarray

        def labelled(of: Variable) -> tuple:
            attributes = {"units": of.unit, "long_name": of.meaning}
            return of.dimensions, np.asarray(of.values), attributes

        every = {name: labelled(variable) for name, variable in self.variables().items()}
        labels = {name: every.pop(name) for name in self.coordinates}
        return xarray.Dataset(every, coords=labels, attrs=dict(self.attributes()))

    def to_pandas(self) -> "pandas.DataFrame":
        """The result as a table, one row a member of its dimension.

        Raises `ValueError` where the variables do not share one dimension: use `to_xarray`.
        """
        data = self.to_xarray()
        if len(data.sizes) != 1:
            dimensions = ", ".join(str(name) for name in data.sizes) or "none"
            raise ValueError(
                f"`{type(self).__name__}` has these dimensions: {dimensions}. A table has one:"
                " use `.to_xarray()`."
            )
        return data.to_dataframe().reset_index()

    def plot(self, **settings: Any) -> "matplotlib.figure.Figure":
        """The figure that shows this result; `settings` are those of its function in `sj.plot`."""
        if _drawing_module is None:
            raise ValueError("no figures are registered: `import snrmjax` registers them.")
        return importlib.import_module(_drawing_module).plot_result(self, **settings)


def draw_with(module: str) -> None:
    """Names the module whose `plot_result` draws results; it is imported with the first figure."""
    global _drawing_module
    _drawing_module = module
