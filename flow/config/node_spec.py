"""An entry of a pipeline file: its class, and the object of that class with the parameters of the entry."""

from __future__ import annotations

import filecmp
import sys
from collections.abc import Collection, Iterable, Mapping
from dataclasses import Field, dataclass, is_dataclass
from importlib import import_module
from pathlib import Path
from types import UnionType
from typing import Any, Union, get_args, get_origin

from flow.config.yaml_tree import Value, nearest_or_all
from flow.contracts import nearest
from flow.parameters import coerced, is_required, parameters_of
from flow.runtime.graph import YamlLocation, hints_of, is_aligner
from flow.runtime.ledger import failure

MODULES = ("flow.align", "stages", "recordings")  # whose classes a pipeline file names without a path of its own
OWN_PACKAGES = {module.partition(".")[0] for module in MODULES}
ROLES = {  # the attributes that a class of that role needs
    "source": ("streams", "open"),
    "sink": ("suffix", "wants", "open", "write", "close"),
    "stage": ("__call__",),
}


@dataclass(frozen=True)
class NodeSpec:
    """The source, a stream or a sink as the file describes it; `kind` is the class under `use`."""

    item: Value
    use: str
    kind: type

    @classmethod
    def read(cls, item: Value, what: str, role: str) -> NodeSpec:
        """The entry with its class, which must fit the role; what: the name of the entry in messages."""
        use = mapping(item, what).get("use")
        if use is None:
            raise item.place.error(f"{what} lacks 'use', its class, such as stages.Match")
        if not isinstance(use.value, str) or not all(use.value.split(".")) or "." not in use.value:
            raise use.place.error(f"'use: {use.plain()}' must be a module and a class, such as stages.Match")
        kind = class_at(use.value, use.place)
        if not (role == "stage" and is_aligner(kind)) and (needed := lacking(kind, role)):
            raise use.place.error(f"{use.value} is no {role}: it has no '{needed[0]}'")
        return cls(item, use.value, kind)

    @property
    def place(self) -> YamlLocation:
        """The line of the entry."""
        return self.item.place

    def place_of(self, key: str) -> YamlLocation:
        """The line of one of its keys."""
        return self.item.value[key].place  # type: ignore[no-any-return]

    def items_of(self, key: str) -> list[tuple[Any, YamlLocation]]:
        """The items of the list at one of its keys, each with its line."""
        return [(item.plain(), item.place) for item in self.item.value[key].value]

    def given(self, but: Collection[str] = ()) -> dict[str, Value]:
        """Its keys except `use` and those in `but`."""
        return {key: value for key, value in self.item.value.items() if key != "use" and key not in but}

    def parameters(self) -> dict[str, Field[Any]]:
        """The parameters of its class."""
        return parameters_of(self.kind)

    def inner_parameters(self) -> list[str]:
        """The parameters of its parameters that are dataclasses, such as `rover.max_slope`."""
        kinds = {name: dataclass_of(hints_of(self.kind)[name]) for name in self.parameters()}
        return [f"{name}.{inner}" for name, kind in kinds.items() if kind is not None for inner in parameters_of(kind)]

    def made(self, inputs: Collection[str] = ()) -> Any:
        """The object that the entry describes; inputs: keys that are no parameters."""
        try:
            return _constructed(self.kind, self.use, self.given(but=inputs), self.place)
        except TypeError as error:
            raise self.place_of("use").error(str(error)) from error


def _constructed(kind: type, name: str, given: Mapping[str, Value], place: YamlLocation) -> Any:
    """An object of a dataclass with the given parameters; name: its name in messages. Raises TypeError for annotations
    that cannot be read."""
    hints, values, parameters = hints_of(kind), {}, parameters_of(kind)
    for key, value in given.items():
        if key not in parameters:
            raise value.key_place.error(f"{name} has no parameter '{key}'{nearest_or_all(key, [*parameters])}")
        inner = dataclass_of(hints[key])
        if inner is not None and isinstance(value.value, dict):
            values[key] = _constructed(inner, f"{name}.{key}", value.value, value.place)
        elif inner is not None and value.value is not None:
            names = ", ".join(parameters_of(inner))
            raise value.place.error(f"{name}.{key}: expected a mapping of {names}, not {value.plain()!r}")
        else:
            try:
                values[key] = coerced(value.plain(), hints[key], parameters[key])
            except (ValueError, OverflowError) as error:
                raise value.place.error(f"{name}.{key}: {error}") from error
    for key, parameter in parameters.items():
        if key not in values and is_required(parameter):
            raise place.error(f"{name} needs its parameter '{key}'")
    try:
        return kind(**values)
    except (Exception, SystemExit) as error:  # a user's class may raise anything
        named = [key for key in values if f"{kind.__name__}.{key}" in str(error)]
        at = given[named[-1]].place if named else place_at_fault(given.values(), place)
        raise at.error(str(error) if isinstance(error, ValueError) else failure(error)) from error


def dataclass_of(hint: Any) -> type | None:
    """The dataclass in the type of a parameter, or None."""
    for kind in get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,):
        if isinstance(kind, type) and is_dataclass(kind):
            return kind
    return None


def place_at_fault(values: Iterable[Value], place: YamlLocation) -> YamlLocation:
    """The place of the last value that the command line set, or else `place`."""
    by_hand = [value.place for value in values if value.place.line is None]
    return by_hand[-1] if by_hand else place


def class_at(use: str, place: YamlLocation) -> type:
    """The dataclass that an entry at this place names."""
    module_name, _, name = use.rpartition(".")
    try:
        __import__(module_name)  # it has no line of its own in a traceback, unlike importlib.import_module
    except ModuleNotFoundError as error:
        if error.name != module_name.partition(".")[0]:
            raise place.error(f"cannot import '{module_name}': {failure(error)}{_meant(use)}") from error
        where = f"beside {place.file}" if place.line else "in the folder"
        remedy = _meant(use) or "; set PYTHONPATH to its folder"
        raise place.error(f"there is no module '{error.name}' {where} or on the Python path{remedy}") from error
    except (Exception, SystemExit) as error:  # a user's module may raise anything
        raise place.error(f"cannot import '{module_name}': {failure(error)}") from error
    module = sys.modules[module_name]
    _check_origin(module_name.partition(".")[0], place)
    kind = getattr(module, name, None)
    if isinstance(kind, type) and is_dataclass(kind):
        if any(isinstance(value, Field) for value in vars(kind).values()):  # a base is a dataclass
            frozen = "(frozen=True)" * kind.__dataclass_params__.frozen  # type: ignore[attr-defined]
            raise place.error(f"{use} has parameters, but is not a dataclass; decorate it with @dataclass{frozen}")
        return kind
    if hasattr(module, name):
        remedy = "decorate it with @dataclass" if isinstance(kind, type) else "a stage is a class with __call__"
        raise place.error(f"{use} is not a dataclass; {remedy}")
    listed = [n for n in getattr(module, "__all__", dir(module)) if not n.startswith("_")]
    known = [n for n in listed if is_dataclass(getattr(module, n, None))]
    raise place.error(f"'{module_name}' has no dataclass '{name}'{nearest(name, known) or _meant(use)}")


def _check_origin(top: str, place: YamlLocation) -> None:
    """Refuse a module, or one of a package, that is not the one beside the file: Python has one module of a name."""
    if place.folder is None or top in OWN_PACKAGES:
        return
    for name, module in sys.modules.copy().items():
        if name.partition(".")[0] != top:
            continue
        file = getattr(module, "__file__", None) or "Python's own"
        base = place.folder.joinpath(*name.split("."))
        for beside in (base.with_suffix(".py"), base / "__init__.py"):
            if beside.is_file() and not (Path(file).is_file() and filecmp.cmp(beside, file, shallow=False)):
                raise place.error(f"the name '{name}' is taken by another module ({file}); rename {beside}")


def _meant(use: str) -> str:
    """The class of the product that is nearest to one that is not found, as the end of the sentence."""
    return nearest(use, [f"{module}.{name}" for module in MODULES for name in import_module(module).__all__])


def lacking(kind: type, role: str) -> list[str]:
    """The attributes that a class lacks for a role."""
    return [name for name in ROLES[role] if not any(name in vars(base) for base in kind.__mro__)]


def type_name(kind: Any) -> str:
    """A type in messages: `Tilt`, `Tilt | Pose` or `list of float`."""
    if get_origin(kind) in (Union, UnionType):
        return " | ".join(map(type_name, get_args(kind)))
    if get_origin(kind) is tuple:
        return f"list of {type_name(get_args(kind)[0])}"
    kind = get_origin(kind) or kind
    return kind.__name__.replace("NoneType", "None") if isinstance(kind, type) else str(kind)


def mapping(item: Value, what: str) -> dict[str, Value]:
    """The keys of an entry; what: the name of the entry in messages."""
    if not isinstance(item.value, dict):
        raise item.place.error(f"{what} must be a mapping of names to values")
    return item.value
