"""The graph of a pipeline: a source, nodes joined by named typed streams, and sinks.

Every stream has a clock, the stream whose messages give it its stamps. A source stream is its own clock, and so are
pairs. A sampled stream has the clock that it is aligned to, and the output of a stage has the clock of its inputs. All
stages and sinks of a graph share one clock; aligners join the others.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from inspect import Parameter, signature
from itertools import repeat
from numbers import Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from flow.contracts import Sink, StageError, counted, unaliased
from flow.errors import PipelineError
from flow.runtime.ledger import failure


@dataclass(frozen=True)
class YamlLocation:
    """A line of a pipeline file, or a setting of the command line (`line` is then None).

    used_at: for a line of a template, the place that uses the template; folder: of a file of the user's own.
    """

    file: str
    line: int | None
    used_at: YamlLocation | None = None
    folder: Path | None = None

    def error(self, sentence: str) -> PipelineError:
        """The error about this place."""
        return PipelineError(f"{self._shown}: {sentence}{self._uses}")

    @property
    def _shown(self) -> str:
        return self.file if self.line is None else f"{self.file}:{self.line}"

    @property
    def _uses(self) -> str:
        """The places that use the template, from the inside out."""
        return "" if self.used_at is None else f" (template used at {self.used_at._shown}){self.used_at._uses}"


@dataclass(frozen=True)
class Node:
    """A stage or an aligner: `actor` turns `inputs` (port -> stream) into the stream `name` of type `output`."""

    name: str
    use: str
    actor: Any
    inputs: Mapping[str, str]
    output: type
    clock: str
    optional: bool
    place: YamlLocation

    @property
    def aligns(self) -> bool:
        """Whether the actor is an aligner, which gets messages in log order, and not a stage."""
        return is_aligner(type(self.actor))

    @property
    def stateful(self) -> bool:
        """Whether the actor is a stage with state; it gets frames one at a time, in stamp order."""
        return not self.aligns and has_state(type(self.actor))

    @property
    def sparse(self) -> bool:
        """Whether the actor is a stage that may return None, where a frame has nothing new."""
        return not self.aligns and NoneType in get_args(_returned(type(self.actor)))

    def checked(self, value: Any, given: Iterable[Any], stamp: int | None) -> Any:
        """A result, read-only; refused if of another type, or with a stamp of neither the frame nor an input.

        A stage that can flush may return what it has kept, with an earlier stamp.
        """
        if why := misfit(value, self.output):
            raise TypeError(f"{self.use} returned {why}")
        stamps, own = {stamp, None, *(getattr(item, "stamp", None) for item in given)}, getattr(value, "stamp", None)
        kept = own is not None and stamp is not None and own < stamp and hasattr(self.actor, "flush")
        if own not in stamps and not kept:
            raise StageError(f"{self.use} returned the stamp {own} ns, not that of its frame")
        return frozen(value, copies=not type(self.actor).__module__.startswith("stages."))


def frozen(value: Any, copies: bool) -> Any:
    """An item with read-only arrays. A list, dict or tuple, and those in it, is another one.

    copies: whether views are copied, as their maker may go on to write to the array that they are of.
    """
    import numpy as np  # which help does not need

    kind = type(value)
    if kind in (list, tuple):
        return kind([frozen(part, copies) for part in value])
    if kind is dict:
        return {key: frozen(part, copies) for key, part in value.items()}
    if isinstance(value, np.ndarray):
        if copies and isinstance(value.base, np.ndarray) and value.base.flags.writeable:
            value = value.copy()
        value.flags.writeable = False
    elif isinstance(value, Mapping | tuple | list):
        for part in value.values() if isinstance(value, Mapping) else value:
            frozen(part, copies)
    elif is_dataclass(value):
        for one in fields(value):
            part = getattr(value, one.name, None)
            if (fixed := frozen(part, copies)) is not part and isinstance(part, np.ndarray):
                object.__setattr__(value, one.name, fixed)
    return value


@dataclass(frozen=True)
class TemplateUse:
    """The template that a stream uses, and the parameters that differ from the template's own."""

    template: str
    parameters: Mapping[str, Any]


@dataclass(frozen=True)
class Graph:
    """A checked pipeline: configuration that no run changes.

    nodes: every stream comes before its use; kinds: stream -> type; left_out: optional stream -> why a log does not
    have it; templates: stream -> the template whose output it is. The other streams of that template are called
    `stream/...`; changes: the texts of --set that are in it.
    """

    name: str
    text: str
    source: Any
    source_use: str
    nodes: tuple[Node, ...]
    sinks: tuple[tuple[str, Sink], ...]
    kinds: Mapping[str, type] = field(default_factory=dict)
    left_out: Mapping[str, str] = field(default_factory=dict)
    templates: Mapping[str, TemplateUse] = field(default_factory=dict)
    changes: tuple[str, ...] = ()

    @property
    def clock(self) -> str:
        """The clock of all stages."""
        return next(node.clock for node in self.nodes if not node.aligns)

    @property
    def stages(self) -> tuple[Node, ...]:
        """The nodes that are stages."""
        return tuple(node for node in self.nodes if not node.aligns)

    @property
    def aligners(self) -> tuple[Node, ...]:
        """The nodes that are aligners."""
        return tuple(node for node in self.nodes if node.aligns)

    @property
    def frame_streams(self) -> dict[str, type]:
        """The streams with one item in every frame, in order; sinks can get these."""
        clocks = {node.name: node.clock for node in self.nodes} | {self.clock: self.clock}
        return {name: self.kinds[name] for name in clocks if clocks[name] == self.clock}

    @property
    def source_streams(self) -> set[str]:
        """The streams of the source that the nodes read."""
        made = {node.name for node in self.nodes}
        return {stream for node in self.nodes for stream in node.inputs.values()} - made

    def upstream_of(self, streams: Iterable[str], given: Collection[str] = ()) -> Graph:
        """The graph of some streams and all that they depend on, up to the streams given."""
        needed = set(streams) - {*given}
        for node in reversed(self.nodes):  # every node comes after its inputs
            if node.name in needed:
                needed |= {*node.inputs.values()} - {*given}
        return replace(self, nodes=tuple(node for node in self.nodes if node.name in needed))

    def without(self, missing: Mapping[str, str]) -> Graph:
        """The graph without the optional nodes that need a stream in `missing` (stream -> why it is missing).

        Ports that need no connection stay open. Raises PipelineError with the reason where a node that is not optional
        needs the stream, or where no stage is left.
        """
        gone = dict(missing)
        kept = []
        for node in self.nodes:
            lost = {port: gone[stream] for port, stream in node.inputs.items() if stream in gone}
            left = {port: stream for port, stream in node.inputs.items() if port not in lost}
            needed = [why for port, why in lost.items() if port not in ports_of(type(node.actor))[1]]
            if not needed and lost and (why := unfit(node.name, node.actor, left)):
                needed = [f"{why}, and {next(iter(lost.values()))}"]
            if not needed:
                kept.append(replace(node, inputs=left))
            elif node.optional:
                gone[node.name] = needed[0]
            else:
                raise PipelineError(needed[0])
        if all(node.aligns for node in kept):
            raise PipelineError(f"no stage of the pipeline {self.name} can run: {next(iter(gone.values()))}")
        made = {node.name for node in self.nodes}
        return replace(self, nodes=tuple(kept), left_out={name: why for name, why in gone.items() if name in made})


def unfit(name: str, actor: Any, inputs: Collection[str]) -> str:
    """Why the stage of stream `name` cannot work with only these ports connected; empty where it can."""
    try:
        getattr(actor, "check_inputs", lambda inputs: None)(set(inputs))
    except ValueError as error:
        return f"stream '{name}': {error}"
    return ""


def is_aligner(kind: type) -> bool:
    """Whether this is a class of aligners (see `flow.align`), and not of stages."""
    return hasattr(kind, "start") and hasattr(kind, "ports")


def start(stages: Iterable[Node]) -> dict[str, Any]:
    """Stream -> new state, for one run, of the stages that have one; raises PipelineError where `start` fails."""
    states = {}
    for node in stages:
        if node.stateful:
            try:
                states[node.name] = node.actor.start()
            except Exception as error:  # the stage may be the user's own
                raise node.place.error(f"'{node.name}' cannot start: {failure(error)}") from error
    return states


def has_state(kind: type) -> bool:
    """Whether stages of this class have a state: `start` makes it for a run, `__call__` takes it as `state`."""
    return hasattr(kind, "start")


def ports_of(kind: type) -> tuple[dict[str, Any], set[str]]:
    """The input ports of a stage or aligner class (name -> type), and those that need no connection.

    The argument `state` is no port. Raises TypeError for a stage with an input without name or type, or with only one
    of `start` and `state`.
    """
    if is_aligner(kind):
        return dict.fromkeys(kind.ports, object), set()  # type: ignore[attr-defined]
    hints = hints_of(kind.__call__)
    parameters = list(signature(kind.__call__).parameters.values())[1:]
    state = next((parameter for parameter in parameters if parameter.name == "state"), None)
    if has_state(kind) and (state is None or state.kind is not Parameter.KEYWORD_ONLY):
        raise TypeError(f"{kind.__name__} has 'start', so its __call__ must take 'state' by keyword only (after '*')")
    users = [name for name in ("finding", "flush") if hasattr(kind, name)]
    if not has_state(kind) and (state is not None or users):
        what = users[0] if state is None else "__call__"
        raise TypeError(f"{kind.__name__}.{what} needs a 'state', so {kind.__name__} must have 'start', which makes it")
    parameters = [parameter for parameter in parameters if parameter.name != "state"]
    for parameter in parameters:
        if parameter.kind not in (Parameter.POSITIONAL_OR_KEYWORD, Parameter.KEYWORD_ONLY):
            raise TypeError(f"{kind.__name__}.__call__ must take each input by its name, unlike '{parameter}'")
        if parameter.name not in hints:
            raise TypeError(f"{kind.__name__}.__call__ does not say the type of its input '{parameter.name}'")
    unneeded = {parameter.name for parameter in parameters if parameter.default is not Parameter.empty}
    return {parameter.name: hints[parameter.name] for parameter in parameters}, unneeded


def hints_of(annotated: Any) -> dict[str, Any]:
    """The annotated types of a class or function; raises TypeError where they cannot be resolved."""
    try:
        return {name: unaliased(kind) for name, kind in get_type_hints(annotated).items()}
    except Exception as error:  # an annotation may be any expression
        raise TypeError(f"the annotations of {annotated.__qualname__} cannot be read: {error}") from error


def accepts(wanted: Any, given: type) -> bool:
    """Whether a port annotated `wanted` takes items of type `given`."""
    if _is_union(wanted):
        return any(accepts(option, given) for option in get_args(wanted))
    wanted, given = get_origin(wanted) or wanted, get_origin(given) or given
    if wanted is float and given is int:
        return True
    return wanted is Any or (isinstance(wanted, type) and issubclass(given, wanted))


def misfit(value: Any, kind: Any) -> str:
    """Why a stage that is annotated to return `kind` may not return this value: "str, not float"; empty where it may.

    A number of numpy is a number. The numbers of an array may be of another size, but not of another kind.
    """
    if _is_union(kind):
        found = [misfit(value, option) for option in get_args(kind)]
        return found[0] if all(found) else ""
    plain, parts = get_origin(kind) or kind, get_args(kind)
    if plain is Any or not isinstance(plain, type):
        return ""
    number = {bool: "b", int: "iu", float: "fiu"}.get(plain, "")
    if number and getattr(value, "shape", None) == ():
        fits = value.dtype.kind in number
    else:
        fits = isinstance(value, Real if plain is float else plain)
    if not fits:
        return f"{type(value).__name__}, not {plain.__name__}"
    if plain is tuple and parts and parts[-1] is not Ellipsis and len(value) != len(parts):
        return f"{counted(len(value), 'value')}, not {len(parts)}"
    for name, item, wanted in _contents(value, plain, parts):
        if why := misfit(item, wanted):
            return f"{why}, as {name!r}"
    return array_misfit(value.dtype.type, parts) if hasattr(value, "dtype") else ""


def array_misfit(given: type, parts: tuple[Any, ...]) -> str:
    """Why an array with numbers of type `given` is not annotated so; empty where it is.

    parts: the arguments of its annotated type, such as those of `ndarray[Any, dtype[float64]]`.
    """
    for wanted in (scalar for part in parts[1:] for scalar in get_args(part)):
        if isinstance(wanted, type) and not issubclass(given, (wanted, wanted.__mro__[1])):
            return f"an array of {given.__name__}, not of {wanted.__name__}"
    return ""


def _contents(value: Any, plain: type, parts: tuple[Any, ...]) -> Iterator[tuple[Any, Any, Any]]:
    """Name, item and annotated type of what is in a value; a field may be None. plain, parts: its type, taken apart."""
    if is_dataclass(value) and not type(value).__module__.startswith("stages."):  # a user's own
        fields = ((name, getattr(value, name), kind) for name, kind in hints_of(type(value)).items())
        yield from (field for field in fields if field[1] is not None)
    elif isinstance(value, Mapping) and parts:
        yield from ((name, item, parts[1]) for name, item in value.items())
    elif type(value) in (list, tuple) and parts:
        kinds = parts if plain is tuple and parts[-1] is not Ellipsis else repeat(parts[0])
        yield from ((number, item, kind) for number, (item, kind) in enumerate(zip(value, kinds, strict=False)))


def output_of(actor: Any, kinds: dict[str, type], place: YamlLocation) -> type:
    """The type of the stream that `actor` makes from inputs of these types; X for a stage that returns X | None."""
    if is_aligner(type(actor)):
        try:
            return actor.output(kinds)  # type: ignore[no-any-return]
        except TypeError as error:
            raise place.error(f"{error}") from error
    returned = _returned(type(actor))
    if _is_union(returned):
        items = [option for option in get_args(returned) if option is not NoneType]
        returned = items[0] if len(items) == 1 else returned
    origin = get_origin(returned) or returned  # of `NDArray[...]` and `dict[str, float]` the class
    if not isinstance(origin, type) or origin is UnionType:
        raise place.error(f"{type(actor).__name__}.__call__ does not say which one type it returns")
    return returned  # type: ignore[no-any-return]


def _returned(kind: type) -> Any:
    """The return annotation of a stage class."""
    return hints_of(kind.__call__).get("return")


def _is_union(kind: Any) -> bool:
    return get_origin(kind) in (Union, UnionType)


def clock_of(name: str, actor: Any, clocks: dict[str, str], place: YamlLocation) -> str:
    """The clock of stream `name`; `clocks` maps input ports to theirs."""
    if is_aligner(type(actor)):
        return name if actor.clock is None else clocks[actor.clock]
    if len(set(clocks.values())) > 1:
        mixed = ", ".join(f"{port} on '{clock}'" for port, clock in clocks.items())
        raise place.error(f"'{name}' joins streams of different clocks ({mixed}); align them first (flow.align)")
    return next(iter(clocks.values()))


def in_order(inputs: Mapping[str, Iterable[str]], places: Mapping[str, YamlLocation]) -> list[str]:
    """Names sorted so that each comes after its inputs; raises PipelineError naming the streams of a cycle."""
    done: list[str] = []
    path: list[str] = []

    def visit(name: str) -> None:
        if name in done or name not in inputs:
            return
        if name in path:
            cycle = " -> ".join([*path[path.index(name) :], name])
            raise places[name].error(f"the streams form a cycle: {cycle}")
        path.append(name)
        for stream in inputs[name]:
            visit(stream)
        path.pop()
        done.append(name)

    for name in inputs:
        visit(name)
    return done
