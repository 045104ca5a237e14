"""Settings and the changes of the command line: `$name` in a pipeline file, and `--set stream.parameter=value`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from flow.config.yaml_tree import Value, nearest, read
from flow.errors import UsageError
from flow.runtime.graph import YamlLocation


@dataclass(frozen=True)
class Change:
    """One `--set`: the new value of the key that `keys` lead to in the entry `target`, such as a stream."""

    target: str
    keys: tuple[str, ...]
    value: Value

    @classmethod
    def read(cls, override: str) -> Change:
        """The change that `stream.parameter=value` or `setting=value` describes."""
        path, separator, text = override.partition("=")
        names = path.strip().split(".")
        if names[0] == "sinks" and len(names) > 1:
            names = names[1:]
        if not (separator and all(names)):
            raise UsageError(f"--set {override}: write stream.parameter=value, or setting=value")
        value = read(text, lambda line: YamlLocation(f"--set {override}", None))
        return cls(names[0], tuple(names[1:]), value)

    def applied(self, item: Value) -> Value:
        """`item`, the entry of this name, with the change; it keeps its place."""
        return Value(_with_value(item, self.target, self.keys, self.value).value, item.place)


def with_settings(tree: Value, changes: Iterable[Change]) -> tuple[Value, list[Change]]:
    """The pipeline file with its settings filled in where `$name` stands, and the changes that are left to apply.

    The changes of settings come first, then the settings are filled in, then the source and the sinks are changed. The
    changes of streams are left.
    """
    settings, left = dict(_settings(tree)), []
    sinks = {_class_name(item): number for number, item in enumerate(_items(tree, "sinks"))}
    entries = {*_streams(tree), *({"source"} & tree.value.keys()), *sinks}
    for change in changes:
        if change.keys and (change.target in entries or "/" in change.target):
            left.append(change)
        elif change.target in settings:
            settings[change.target] = _with_value(settings[change.target], change.target, change.keys, change.value)
        else:
            raise change.value.place.error(_unknown(change, entries, settings))
    parts = {
        key: item if key in ("templates", "settings") else filled_in(item, settings, "there is no setting '{}'")
        for key, item in tree.value.items()
    }
    used = set(_texts(tree, leave_out="templates"))
    for name, given in _settings(tree).items():
        if any(isinstance(text, str) and text.startswith("$") for text in _texts(settings[name])):
            raise settings[name].place.error(f"the setting '{name}' refers to another setting; give it a value")
        if f"${name}" not in used:
            raise given.place.error(f"the setting '{name}' is used nowhere; write ${name} where it belongs")
    of_streams = []
    for change in left:
        filled = Change(change.target, change.keys, filled_in(change.value, settings, "there is no setting '{}'"))
        if change.target == "source":
            parts["source"] = filled.applied(parts["source"])
        elif change.target in sinks and change.target not in _streams(tree):
            listed = list(parts["sinks"].value)
            listed[sinks[change.target]] = filled.applied(listed[sinks[change.target]])
            parts["sinks"] = Value(listed, parts["sinks"].place)
        else:
            of_streams.append(filled)
    return Value(parts, tree.place), of_streams


def filled_in(item: Value, values: Mapping[str, Value], missing: str) -> Value:
    """The tree `item` with a value where its `$name` stands; missing: the sentence about a name without a value."""
    if isinstance(item.value, dict):
        return Value({key: filled_in(value, values, missing) for key, value in item.value.items()}, item.place)
    if isinstance(item.value, list):
        return Value([filled_in(value, values, missing) for value in item.value], item.place)
    if not isinstance(item.value, str) or not item.value.startswith("$"):
        return item
    name = item.value[1:]
    if name not in values:
        raise item.place.error(missing.format(name) + nearest(name, values))
    return replace(values[name], filled_at=item.place)


def _unknown(change: Change, entries: Iterable[str], settings: Mapping[str, Value]) -> str:
    """The sentence about a change whose target is neither an entry nor a setting."""
    target, keys = change.target, change.keys
    if keys and target == "settings":
        return f"a setting has no prefix; write {keys[0]}=value"
    if keys:
        return f"there is no stream '{target}'{nearest(target, [*entries, *settings])}"
    if target in entries:
        return f"name the parameter of '{target}', as in {target}.parameter=value{nearest(target, settings)}"
    return f"the pipeline has no setting '{target}'{nearest(target, settings)}"


def _settings(tree: Value) -> dict[str, Value]:
    """The values that a pipeline file names once, to use them in several places."""
    given = tree.value.get("settings")
    if given is None:
        return {}
    if not isinstance(given.value, dict):
        raise given.place.error("'settings' must be a mapping of names to values")
    return given.value


def _streams(tree: Value) -> dict[str, Value]:
    streams = tree.value["streams"].value if "streams" in tree.value else {}
    return streams if isinstance(streams, dict) else {}


def _items(tree: Value, key: str) -> list[Value]:
    given = tree.value[key].value if key in tree.value else []
    return given if isinstance(given, list) else []


def _class_name(item: Value) -> str:
    """The class of a sink without its module, by which `--set` names it."""
    use = item.value.get("use") if isinstance(item.value, dict) else None
    return str(use.value).rpartition(".")[2] if use is not None else ""


def _with_value(item: Value, what: str, keys: Sequence[str], value: Value) -> Value:
    """`item`, which is called `what`, with `value` where `keys` lead to, a mapping in a mapping."""
    if not keys:
        return value
    if not isinstance(item.value, dict):
        raise value.place.error(f"'{what}' is not a mapping")
    inner = item.value.get(keys[0], Value({}, value.place))
    changed = _with_value(inner, f"{what}.{keys[0]}", keys[1:], value)
    return Value({**item.value, keys[0]: changed}, value.place)


def _texts(item: Value, leave_out: str = "") -> list[Any]:
    """All values in `item` that contain no others, without those under one key."""
    if not isinstance(item.value, dict | list):
        return [item.value]
    if isinstance(item.value, list):
        return [text for part in item.value for text in _texts(part)]
    return [text for key, part in item.value.items() if key != leave_out for text in _texts(part)]
