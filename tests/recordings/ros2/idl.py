"""ROS 2 message types as rosidl writes them in IDL, and rosbag2 into its logs: with comments, includes, annotations,
typedefs for arrays of fixed size, and a module of constants."""

from typing import Any

from recordings.ros2.cdr import standard_types

BASE, NAME, ARRAY = 1, 2, 3  # kinds of fields in the type store; a sequence is 4
NAMES = {"float64": "double", "float32": "float", "bool": "boolean", "byte": "octet"}


def idl_schema(kind: str) -> bytes:
    """The definition of a type of the type store, followed by those of all types that it refers to."""
    kinds = [kind]
    for each in kinds:
        kinds += [other for other in _references(each) if other not in kinds]
    return "".join(f"{'=' * 80}\nIDL: {each}\n{_definition(each)}" for each in kinds).encode()


def _definition(kind: str) -> str:
    package, _, name = kind.split("/")
    constants, fields = standard_types().fielddefs[kind]
    lines = [
        "// generated from rosidl_adapter/resource/msg.idl.em",
        f"// with input from {package}/msg/{name}.msg\n",
        *(f'#include "{other}.idl"' for other in _references(kind)),
        f"\nmodule {package} {{\n  module msg {{",
    ]
    arrays = {_array(detail): detail for _, (node, detail) in fields if int(node) == ARRAY}
    lines += [f"    typedef {_type(*inner)} {alias}[{size}];" for alias, (inner, size) in arrays.items()]
    if constants:
        lines.append(f"    module {name}_Constants {{")
        lines += [f"      const {NAMES.get(base, base)} {label} = {value};" for label, base, value in constants]
        lines.append("    };")
    lines += [f'    @verbatim (language="comment", text=\n      "a {name}; # of" "\\n"\n      "things")']
    lines.append(f"    struct {name} {{")
    for label, (node, detail) in fields:
        shown = _array(detail) if int(node) == ARRAY else _type(node, detail)
        lines.append(f'      @unit (value="1")\n      {shown} {label};\n')
    return "\n".join([*lines, "    };\n  };\n};", ""])


def _references(kind: str) -> list[str]:
    found = []
    for _, (node, detail) in standard_types().fielddefs[kind][1]:
        inner, name = (node, detail) if int(node) <= NAME else detail[0]
        if int(inner) == NAME and name not in found:
            found.append(name)
    return found


def _array(detail: Any) -> str:
    (node, inner), size = detail
    return f"{_type(node, inner).replace('::', '__')}__{size}"


def _type(node: int, detail: Any) -> str:
    if int(node) == NAME:
        return str(detail.replace("/", "::"))
    if int(node) == BASE:
        return NAMES.get(detail[0], detail[0])
    return f"sequence<{_type(*detail[0])}>"
