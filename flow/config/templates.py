"""Templates: named groups of streams with inputs, parameters and one output, expanded when a pipeline is loaded.

A use of a template makes the stream of its own name, which is the template's output. The other streams of the template
are called `use/stream`. A template is found in the pipeline file or among the parts that ship.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from flow.config.node_spec import NodeSpec, mapping
from flow.config.overrides import Change, filled_in
from flow.config.yaml_tree import Value, nearest_or_all, read
from flow.contracts import nearest
from flow.runtime.graph import TemplateUse, YamlLocation, ports_of

SHIPPED = Path(__file__).parent.parent / "pipelines"
_KEYS = ("inputs", "parameters", "output", "streams")
MAX_STREAMS = 300  # of a pipeline


@dataclass(frozen=True)
class Template:
    """A checked template. inputs: name -> name of a type; parameters: name -> default."""

    name: str
    inputs: Mapping[str, Value]
    parameters: Mapping[str, Value]
    output: str
    streams: Mapping[str, Value]

    @classmethod
    def read(cls, name: str, item: Value) -> Template:
        """The template that a mapping of inputs, parameters, output and streams describes."""
        given = mapping(item, f"template '{name}'")
        for key, value in given.items():
            if key not in _KEYS:
                raise value.place.error(f"template '{name}' has no '{key}'{nearest(key, _KEYS)}")
        for key in ("output", "streams"):
            if key not in given:
                raise item.place.error(f"template '{name}' lacks '{key}'")
        parts = {key: mapping(given[key], f"'{key}'") for key in ("inputs", "parameters", "streams") if key in given}
        template = cls(
            name, parts.get("inputs", {}), parts.get("parameters", {}), str(given["output"].plain()), parts["streams"]
        )
        if template.output not in template.streams:
            meant = nearest(template.output, template.streams)
            raise given["output"].place.error(f"the output '{template.output}' is not a stream of '{name}'{meant}")
        template._check_names()
        return template

    def _check_names(self) -> None:
        """Refuse a name that is used twice, a `$name` that is no parameter, and a parameter that is not used."""
        for key, item in self.streams.items():
            check_name(key, item.place)
            if key in self.inputs:
                raise item.place.error(f"'{key}' is already an input of template '{self.name}'; choose another name")
        leaves = [leaf for item in self.streams.values() for leaf in item.leaves() if str(leaf.value).startswith("$")]
        uses = {leaf.value[1:]: leaf.place for leaf in leaves}
        for key, place in uses.items():
            if key in self.inputs:
                raise place.error(f"'{key}' is an input of template '{self.name}'; write it without $")
            if key not in self.parameters:
                raise place.error(f"template '{self.name}' has no parameter '{key}'{nearest(key, self.parameters)}")
        for key, item in self.parameters.items():
            if key in (*self.inputs, "use", "template", "optional"):
                raise item.place.error(f"'{key}' cannot name a parameter of '{self.name}'; choose another name")
            if key not in uses:
                unused = f"the parameter '{key}' of '{self.name}' is not used"
                raise item.place.error(f"{unused}; write ${key} to use it, or remove it")
        read = {str(leaf.value).partition("/")[0] for item in self.streams.values() for leaf in item.leaves()}
        for key, item in self.inputs.items():
            if key not in read:
                raise item.place.error(f"no stream of '{self.name}' reads its input '{key}'; connect it, or remove it")


@dataclass(frozen=True)
class TemplateInput:
    """What a use of a template gives to one of its inputs. kind: the name of the declared type, in the template."""

    stream: str
    kind: Value
    template: str
    place: YamlLocation


@dataclass(frozen=True)
class Scope:
    """The names of streams inside one use of a template."""

    streams: Mapping[str, str] = field(default_factory=dict)
    inputs: Mapping[str, TemplateInput] = field(default_factory=dict)

    def stream(self, name: str) -> str | None:
        """The stream that a name inside the template means."""
        first, slash, rest = name.partition("/")
        if first in self.inputs and not slash:
            return self.inputs[first].stream
        return f"{self.streams[first]}{slash}{rest}" if first in self.streams else None


@dataclass(frozen=True)
class StreamSpec:
    """A stream of the pipeline after expansion; scope: None for one that is in no template."""

    item: Value
    scope: Scope | None = None


def check_name(name: str, place: YamlLocation) -> None:
    """Refuse a name that no stream can have."""
    if not (name.isascii() and name.isidentifier()):
        raise place.error(f"'{name}' cannot name a stream; use letters, digits and underscores, no digit first")
    if name == "source":
        raise place.error("'source' cannot name a stream, because it names the settings of the source")


class Library:
    """Finds templates by name: in the pipeline file, and among the parts that ship."""

    def __init__(self, own: Mapping[str, Value]) -> None:
        self._known = {name: Template.read(name, item) for name, item in own.items()}
        self._texts: dict[str, str] = {}

    def comments(self) -> str:
        """The files of the templates found so far, as comments for the end of the pipeline file."""
        lines = [line for name, text in self._texts.items() for line in (f"{name}:", *text.splitlines())]
        return "".join(f"# {line}\n" for line in lines)

    def find(self, name: Value) -> Template:
        """The template that `template: name` means."""
        if not isinstance(name.value, str) or not name.value:
            raise name.place.error(f"'template: {name.plain()}' must be the name of a template")
        parts = {file.stem: file for file in (SHIPPED / "parts").glob("*.yaml")}
        if name.value not in (*self._known, *parts):
            meant = nearest(name.value, [*self._known, *parts]) or "; write it under 'templates' in the pipeline file"
            raise name.place.error(f"there is no template '{name.value}'{meant}")
        if name.value not in self._known:
            shown, text = f"parts/{name.value}.yaml", parts[name.value].read_text(encoding="utf-8")
            self._texts[shown] = text
            self._known[name.value] = Template.read(name.value, read(text, lambda line: YamlLocation(shown, line)))
        return self._known[name.value]


class Expansion:
    """The streams of a pipeline with every template expanded and the changes of streams applied.

    templates: use -> template, for the uses in the pipeline file itself; inputs: of all uses.
    """

    def __init__(self, streams: Mapping[str, Value], library: Library, changes: Iterable[Change]) -> None:
        self.streams: dict[str, StreamSpec] = {}
        self.templates: dict[str, TemplateUse] = {}
        self.inputs: list[TemplateInput] = []
        self._library, self._paths, self._left = library, list[str](), list(changes)  # paths: what changes can name
        for name, item in streams.items():
            check_name(name, item.place)
            self._add(name, name, item)
        for change in self._left:
            meant = nearest(change.target, self._paths)
            raise change.value.place.error(f"there is no stream '{change.target}'{meant}")

    def _add(self, name: str, path: str, item: Value, scope: Scope | None = None, within: tuple[str, ...] = ()) -> None:
        """Add the stream `name`, or the streams of the template that it uses; within: the templates around it."""
        self._paths.append(path)
        if len(self._paths) > MAX_STREAMS:
            raise item.place.error(f"the pipeline has more than {MAX_STREAMS} streams; do templates multiply them?")
        changes = [change for change in self._left if change.target == path]
        self._left = [change for change in self._left if change.target != path]
        is_use = _is_use(item)
        for change in changes:
            if not is_use or change.keys[0] == "template":
                item = change.applied(item)
        if not _is_use(item):
            self.streams[name] = StreamSpec(item, scope)
            return
        template = self._library.find(item.value["template"])
        if template.name in within:
            circle = " -> ".join([*within[within.index(template.name) :], template.name])
            raise item.value["template"].place.error(f"template '{template.name}' uses itself: {circle}")
        for change in changes:
            if change.keys[0] in (*template.inputs, *template.parameters, "optional"):
                item = change.applied(item)
            elif change.keys[0] != "template":  # of the output stream
                _check_key(change, template)
                self._left.append(replace(change, target=f"{path}/{template.output}"))
        self._expand(name, path, item, template, scope, (*within, template.name))

    def _expand(
        self, name: str, path: str, use: Value, template: Template, scope: Scope | None, within: tuple[str, ...]
    ) -> None:
        """Add the streams of a template for one use of it."""
        given = {key: value for key, value in use.value.items() if key not in ("template", "optional")}
        for key, value in given.items():
            if key not in template.inputs and key not in template.parameters:
                valid = [*template.inputs, *template.parameters, "optional"]
                meant = nearest_or_all(key, valid)
                raise value.key_place.error(f"template '{template.name}' has no input or parameter '{key}'{meant}")
        if scope is None:
            own = {key: item.plain() for key, item in template.parameters.items()}
            changed = {key: given[key].plain() for key in own if key in given and given[key].plain() != own[key]}
            self.templates[name] = TemplateUse(template.name, changed)
        inputs = {}
        for key, kind in template.inputs.items():
            if key not in given:
                raise use.place.error(f"'{name}' lacks its input '{key}' (template '{template.name}' needs it)")
            stream = resolved(key, given[key], scope)
            inputs[key] = TemplateInput(stream, kind, template.name, given[key].place)
        self.inputs += inputs.values()
        values = {key: given.get(key, _moved(item, use.place)) for key, item in template.parameters.items()}
        names = {key: name if key == template.output else f"{path}/{key}" for key in template.streams}
        inner = Scope(names, inputs)
        for key, item in template.streams.items():
            moved = filled_in(_moved(item, use.place), values)
            if "optional" in use.value and isinstance(moved.value, dict):
                moved = Value({**moved.value, "optional": use.value["optional"]}, moved.place)
            self._add(names[key], f"{path}/{key}", moved, inner, within)


def resolved(port: str, given: Value, scope: Scope | None) -> str:
    """The stream that an entry gives to a port."""
    if not isinstance(given.value, str):
        raise given.place.error(f"'{port}' must be the name of a stream, not {given.plain()!r}")
    if scope is None or (given.place.line is None and scope.stream(given.value) is None):
        return given.value
    stream = scope.stream(given.value)
    if stream is None:
        meant = nearest(given.value, [*scope.inputs, *scope.streams])
        remedy = meant or "; declare it under inputs, and pass it where the template is used"
        raise given.place.error(f"the template has no stream or input '{given.value}'{remedy}")
    return stream


def _is_use(item: Value) -> bool:
    """Whether an entry uses a template; raises PipelineError where it uses a class at the same time."""
    if not isinstance(item.value, dict) or "template" not in item.value:
        return False
    if "use" in item.value:
        raise item.place.error("an entry must have 'use' or 'template', not both")
    return True


def _check_key(change: Change, template: Template) -> None:
    """Refuse a change of a parameter that neither a template nor the class of its output stream has."""
    output = template.streams[template.output]
    if _is_use(output):
        return
    spec = NodeSpec.read(output, f"stream '{template.output}'", "stage")
    valid = [*ports_of(spec.kind)[0], *spec.parameters(), "use", "optional"]
    if change.keys[0] not in valid:
        meant = nearest(change.keys[0], [*template.inputs, *template.parameters, *valid])
        raise change.value.place.error(
            f"neither template '{template.name}' nor its output, {spec.use}, has '{change.keys[0]}'{meant}"
        )


def _moved(item: Value, use: YamlLocation) -> Value:
    """A value of a template, its place with that of the template's use."""
    place = replace(item.place, used_at=use)
    if isinstance(item.value, dict):
        return Value({key: _moved(value, use) for key, value in item.value.items()}, place)
    if isinstance(item.value, list):
        return Value([_moved(value, use) for value in item.value], place)
    return Value(item.value, place)
