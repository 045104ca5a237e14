"""Settings and the changes of the command line: `$name` in a pipeline file, and `--set stream.parameter=value`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from flow.config.node_spec import mapping
from flow.config.yaml_tree import Value, nearest_or_all, read
from flow.contracts import nearest
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
        path, _, text = override.partition("=")
        names = path.strip().split(".")
        if not (text.strip() and all(names)):
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
    given = mapping(tree.value.get("settings", Value({}, tree.place)), "'settings'")
    settings, of_parts, of_streams = dict(given), list[Change](), list[Change]()
    streams = mapping(tree.value["streams"], "'streams'")
    sinks = {_class_name(item): number for number, item in enumerate(tree.value["sinks"].value)}
    parts = {"source"} | sinks.keys() - streams.keys()
    for change in changes:
        if change.keys and change.target in parts:
            of_parts.append(change)
        elif change.keys and (change.target in streams or "/" in change.target):
            of_streams.append(change)
        elif change.target in settings:
            settings[change.target] = _with_value(settings[change.target], change.target, change.keys, change.value)
        else:
            raise change.value.place.error(_unknown(change, streams, parts, settings))
    filled = {
        key: item if key in ("templates", "settings") else filled_in(item, settings) for key, item in tree.value.items()
    }
    used = {leaf.value for key, item in tree.value.items() if key != "templates" for leaf in item.leaves()}
    for name, item in given.items():
        if any(str(leaf.value).startswith("$") for leaf in settings[name].leaves()):
            raise settings[name].place.error(f"the setting '{name}' refers to another setting; set it to a value")
        if f"${name}" not in used:
            raise item.place.error(f"the setting '{name}' is not used; write ${name} to use it, or remove it")
    for change in (_filled(change, settings) for change in of_parts):
        if change.target == "source":
            filled["source"] = change.applied(filled["source"])
        else:
            number, listed = sinks[change.target], list(filled["sinks"].value)
            listed[number] = change.applied(listed[number])
            filled["sinks"] = Value(listed, filled["sinks"].place)
    return Value(filled, tree.place), [_filled(change, settings) for change in of_streams]


def _filled(change: Change, settings: Mapping[str, Value]) -> Change:
    return replace(change, value=filled_in(change.value, settings))


def filled_in(item: Value, values: Mapping[str, Value]) -> Value:
    """The tree `item` with a value where its `$name` stands. Raises PipelineError for a name without a value."""
    if isinstance(item.value, dict):
        return Value({key: filled_in(value, values) for key, value in item.value.items()}, item.place)
    if isinstance(item.value, list):
        return Value([filled_in(value, values) for value in item.value], item.place)
    if not isinstance(item.value, str) or not item.value.startswith("$"):
        return item
    name = item.value[1:]
    if name not in values:
        raise item.place.error(f"there is no setting '{name}'{nearest(name, values)}")
    return replace(values[name], filled_at=item.place)


def _unknown(change: Change, streams: Mapping[str, Value], parts: Iterable[str], settings: Mapping[str, Value]) -> str:
    """The sentence about a change whose target is neither an entry nor a setting."""
    target, keys, entries = change.target, change.keys, [*streams, *parts]
    of_class = [name for name, item in streams.items() if _class_name(item).lower() == target.lower()]
    if keys and target in ("settings", "streams", "sinks"):
        return f"leave out '{target}.'"
    if keys and of_class:
        return f"write the stream in place of its class '{target}': {' or '.join(of_class)}"
    if keys:
        return f"there is no stream '{target}'{nearest(target, [*entries, *settings])}"
    if target in entries or "/" in target:
        return f"name the parameter of '{target}', as in {target}.parameter=value{nearest(target, settings)}"
    return f"the pipeline has no setting '{target}'{nearest_or_all(target, [*settings])}"


def _class_name(item: Value) -> str:
    """The class of a stream or a sink without its module; `--set` names a sink by it."""
    use = item.value.get("use") if isinstance(item.value, dict) else None
    return str(use.value).rpartition(".")[2] if use is not None else ""


def _with_value(item: Value, what: str, keys: Sequence[str], value: Value) -> Value:
    """`item`, which is called `what`, with `value` where `keys` lead to, a mapping in a mapping."""
    if not keys:
        return value
    if not isinstance(item.value, dict):
        raise value.place.error(f"'{what}' is {item.plain()!r}, not a mapping with '{keys[0]}'")
    inner = item.value.get(keys[0], Value({}, value.place))
    changed = _with_value(inner, f"{what}.{keys[0]}", keys[1:], value)
    return Value({**item.value, keys[0]: changed}, value.place)
