"""An entry of a pipeline file: the class that it uses, and the object that its parameters make of that."""

from __future__ import annotations

import importlib
from collections.abc import Collection, Iterable
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from typing import Any

from flow.config.values import coerced
from flow.config.yaml_tree import Value, nearest
from flow.runtime.graph import YamlLocation, hints_of, is_aligner
from flow.runtime.ledger import failure

_NEEDED = {  # what a class of that role needs to have
    "source": ("streams", "open"),
    "sink": ("suffix", "wants", "open", "write", "close"),
    "stage": ("__call__",),
}


@dataclass(frozen=True)
class NodeSpec:
    """The source, a stream or a sink as the file describes it; `kind` is the class that it names by `use`."""

    item: Value
    use: str
    kind: type

    @classmethod
    def read(cls, item: Value, what: str, role: str) -> NodeSpec:
        """The entry, its class found and fit for its role; what: it is, in words."""
        use = mapping(item, what).get("use")
        if use is None:
            raise item.place.error(f"{what} does not say which class to 'use'")
        if not isinstance(use.value, str) or not all(use.value.split(".")) or "." not in use.value:
            raise use.place.error(f"'use: {use.plain()}' must be a module and a class, such as stages.Match")
        kind = _class(use.value, use.place)
        for needed in () if role == "stage" and is_aligner(kind) else _NEEDED[role]:
            if not any(needed in vars(base) for base in kind.__mro__):
                raise use.place.error(f"{use.value} is no {role}: it has no '{needed}'")
        return cls(item, use.value, kind)

    @property
    def place(self) -> YamlLocation:
        """Where it begins."""
        return self.item.place

    def place_of(self, key: str) -> YamlLocation:
        """Where a key of it stands."""
        return self.item.value[key].place  # type: ignore[no-any-return]

    def place_at_fault(self, keys: Iterable[str]) -> YamlLocation:
        """Where it went wrong, as far as can be told: at the last of the keys that the command line set, if any."""
        by_hand = [place for place in map(self.place_of, keys) if place.line is None]
        return by_hand[-1] if by_hand else self.place

    def given(self, but: Collection[str] = ()) -> dict[str, Value]:
        """What it says beside its class, but for some keys."""
        return {key: value for key, value in self.item.value.items() if key != "use" and key not in but}

    def parameters(self) -> dict[str, Field[Any]]:
        """The parameters of its class."""
        return {item.name: item for item in fields(self.kind) if item.init}

    def made(self, inputs: Collection[str] = ()) -> Any:
        """The object that it describes; `inputs` are no parameters."""
        parameters, values = self.parameters(), {}
        try:
            hints = hints_of(self.kind)
        except TypeError as error:
            raise self.place_of("use").error(str(error)) from error
        for key, value in self.given(but=inputs).items():
            if key not in parameters:
                raise value.place.error(f"{self.use} has no parameter '{key}'{nearest(key, parameters)}")
            try:
                values[key] = coerced(value.plain(), hints[key], parameters[key])
            except (ValueError, OverflowError) as error:
                raise value.place.error(f"{self.use}.{key}: {error}") from error
        for key, parameter in parameters.items():
            if key not in values and parameter.default is MISSING and parameter.default_factory is MISSING:
                raise self.place.error(f"{self.use} needs its parameter '{key}'")
        try:
            return self.kind(**values)
        except (Exception, SystemExit) as error:  # whatever a stage of the user's own may raise
            named = [key for key in values if f"{self.kind.__name__}.{key}" in str(error)]
            place = self.place_of(named[-1]) if named else self.place_at_fault(values)
            raise place.error(str(error) if isinstance(error, ValueError) else failure(error)) from error


def _class(use: str, place: YamlLocation) -> type:
    """The dataclass of that name."""
    module_name, _, name = use.rpartition(".")
    try:
        module = importlib.import_module(module_name)
    except (Exception, SystemExit) as error:  # whatever a module of the user's own may raise
        raise place.error(f"cannot import '{module_name}': {type(error).__name__}: {error}") from error
    kind = getattr(module, name, None)
    if isinstance(kind, type) and is_dataclass(kind):
        return kind
    if hasattr(module, name):
        raise place.error(f"{use} is no dataclass, and a pipeline uses no other class; give it @dataclass")
    listed = [n for n in getattr(module, "__all__", dir(module)) if not n.startswith("_")]
    known = [n for n in listed if is_dataclass(getattr(module, n, None))]
    raise place.error(f"'{module_name}' has no '{name}' that a pipeline can use{nearest(name, known)}")


def mapping(item: Value, what: str) -> dict[str, Value]:
    """The keys of an entry that has such; what: it is, in words."""
    if not isinstance(item.value, dict):
        raise item.place.error(f"{what} must be a mapping of names to values")
    return item.value
