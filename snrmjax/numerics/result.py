"""Base classes of results: printing, conversion to labelled data sets, plotting."""

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, dataclass_transform

import equinox as eqx
import jax
import numpy as np

from snrmjax.numerics.facts import Fact, renderer
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.status import Status
from snrmjax.numerics.units import DEGREE, HERTZ

if TYPE_CHECKING:
    import matplotlib.figure
    import pandas
    import xarray

_SUFFIXES = {"Hz": "_hz", "m/s": "_m_s", "m": "_m", "N": "_n", "V": "_v", "J": "_j", "deg": "_deg"}
# Internal units (rad/s, rad) per unit in files.
_UNITS = {"Hz": HERTZ, "deg": DEGREE}


class Variable(NamedTuple):
    """One quantity of a result, as a labelled data set holds it."""

    dimensions: tuple[str, ...]
    values: Any  # array of that many dimensions, numbers or text
    unit: str  # "Hz", "m/s", "1"; "" for text
    meaning: str  # a few words, as an axis label


class _Quantity(NamedTuple):
    """Metadata of a field of a result."""

    dimensions: tuple[str, ...]
    unit: str
    meaning: str
    name: str
    of: type[Status] | None

    def variables(self, name: str, values: Any) -> dict[str, Variable]:
        """The field's values in the units and under the names of files."""
        values, suffix = np.asarray(values), _SUFFIXES.get(self.unit, "")
        if np.iscomplexobj(values):
            stem, parts = self.name or name, (("re", values.real), ("im", values.imag))
            return {
                f"{stem}_{key}{suffix}": self._variable(part, f"{self.meaning}, {key}")
                for key, part in parts
            }
        if self.of is not None:
            names = [self.of(int(number)).name.lower() for number in values.ravel()]
            values = np.array(names, dtype=np.str_).reshape(values.shape)
        elif self.unit in _UNITS:
            values = values / _UNITS[self.unit]
        elif not self.unit:
            values = values.astype(np.str_)
        return {self.name or name + suffix: self._variable(values, self.meaning)}

    def _variable(self, values: np.ndarray, meaning: str) -> Variable:
        return Variable(self.dimensions, values, self.unit, meaning)


def quantity(
    dimensions: str,
    unit: str,
    meaning: str,
    *,
    name: str = "",
    of: type[Status] | None = None,
    **settings: Any,
) -> Any:
    """A field that is a variable of the result's data set, in place of `equinox.field`.

    Arguments: `dimensions` by name, separated by spaces, "" for a single number; `unit` in files
    and data sets ("1" for none, "" for text): a field in "Hz" holds rad/s and one in "deg" rad;
    `meaning` in a few words; `name` of the variable, by default the field's with the unit's suffix
    (complex numbers become two variables: name, `_re` or `_im`, suffix); `of` the status that
    integers stand for, written by name; others as `equinox.field`.
    """
    about = _Quantity(tuple(dimensions.split()), unit, meaning, name, of)
    return eqx.field(metadata={"quantity": about}, **settings)


def setting(**settings: Any) -> Any:
    """A static field that is an attribute of the data set, such as a method or a status.

    Statuses and enumerations are written by name, facts as sentences.
    """
    return eqx.field(static=True, metadata={"setting": True}, **settings)


class AbstractShown(eqx.Module):
    """Base of objects that print on one screen and as a table in a notebook."""

    def has_screen(self) -> bool:
        """Whether there are values to print; not within `jax.jit`."""
        valueless = (jax.core.Tracer, jax.ShapeDtypeStruct)
        return not any(isinstance(leaf, valueless) for leaf in jax.tree.leaves(self))

    def __repr__(self) -> str:
        """The result on one screen; within `jax.jit` the fields' shapes."""
        return renderer().screen(self) if self.has_screen() else eqx.tree_pformat(self)

    def _repr_html_(self) -> str | None:
        return renderer().html(self) if self.has_screen() else None


@dataclass_transform(field_specifiers=(eqx.field, quantity, setting))
class AbstractResult(AbstractShown):
    """Base of results: a repr of one screen, `to_xarray()`, `to_pandas()` and `plot()`.

    Fields declared by `quantity` and `setting` enter the data set; a result with computed
    quantities adds them to `variables`. Names in `coordinates` become coordinates; one that is
    only a dimension counts from 0.
    """

    coordinates: ClassVar[tuple[str, ...]] = ()

    def variables(self) -> Mapping[str, Variable]:
        """Quantities by name, in the units of files (Hz, m/s)."""
        variables: dict[str, Variable] = {}
        for field in dataclasses.fields(self):
            if "quantity" in field.metadata:
                values = getattr(self, field.name)
                variables |= field.metadata["quantity"].variables(field.name, values)
        return variables

    def attributes(self) -> Mapping[str, str | float | int]:
        """Attributes of the whole result: settings, statuses, notes."""
        return {
            field.name: _attribute(getattr(self, field.name))
            for field in dataclasses.fields(self)
            if "setting" in field.metadata
        }

    def to_xarray(self) -> "xarray.Dataset":
        """The result as an `xarray.Dataset`, with a unit and a meaning on every variable."""
        import xarray

        def labelled(of: Variable) -> tuple:
            attributes = {"units": of.unit, "long_name": of.meaning}
            return of.dimensions, np.asarray(of.values), attributes

        variables = dict(self.variables())
        for of in list(variables.values()):
            for name, size in zip(of.dimensions, np.shape(of.values), strict=True):
                if name in self.coordinates and name not in variables:
                    variables[name] = Variable((name,), np.arange(size), "1", name)
        arrays = {name: labelled(variable) for name, variable in variables.items()}
        labels = {name: arrays.pop(name) for name in self.coordinates}
        return xarray.Dataset(arrays, coords=labels, attrs=dict(self.attributes()))

    def to_pandas(self) -> "pandas.DataFrame":
        """The result as a table, one row per entry of its dimension.

        Raises `ValueError` if the variables do not share one dimension: use `to_xarray`.
        """
        data = self.to_xarray()
        if len(data.sizes) != 1:
            dimensions = ", ".join(str(name) for name in data.sizes) or "none"
            raise InputError(
                f"`{type(self).__name__}` has these dimensions: {dimensions}. A table has one:"
                " use `.to_xarray()`."
            )
        return data.to_dataframe().reset_index()

    def plot(self, **settings: Any) -> "matplotlib.figure.Figure":
        """The figure of this result; `settings` are those of its function in `sj.plot`."""
        return renderer().figure(self, **settings)


def _attribute(value: Any) -> str | float | int:
    """A setting as a data set's attribute: a number, or text."""
    if isinstance(value, Status):
        return value.name.lower()
    if isinstance(value, str | int | float):
        return value
    if isinstance(value, Fact):
        return str(value)
    return "\n".join(str(entry) for entry in value)
