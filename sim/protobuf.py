"""Protocol-buffer messages from a small table of the fields that are read.

A table names each message's fields as (name, number, type): a scalar type's name or
another message's, with "*" behind it when repeated. Fields that a table leaves out
are skipped by the parser, as the wire format allows, so neither generated code nor
the data set's own package is needed. Enumerations are read as `int32`, which has the
same encoding and keeps values that are newer than the table.
"""

from collections.abc import Mapping, Sequence

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import Message

Fields = Sequence[tuple[str, int, str]]

_Field = descriptor_pb2.FieldDescriptorProto
_SCALARS: Mapping[str, _Field.Type.ValueType] = {
    "double": _Field.TYPE_DOUBLE,
    "float": _Field.TYPE_FLOAT,
    "int32": _Field.TYPE_INT32,
    "int64": _Field.TYPE_INT64,
    "bool": _Field.TYPE_BOOL,
    "string": _Field.TYPE_STRING,
    "bytes": _Field.TYPE_BYTES,
}


def build_messages(
    package: str, table: Mapping[str, Fields]
) -> dict[str, type[Message]]:
    """Makes a message class for each entry of `table`, in a pool of their own."""
    file = descriptor_pb2.FileDescriptorProto(
        name=f"{package}.proto", package=package, syntax="proto2"
    )
    for message_name, fields in table.items():
        message = file.message_type.add(name=message_name)
        for name, number, kind in fields:
            _add_field(message, package, name, number, kind)
    # A pool of its own: the process may also hold the real definitions under these
    # names, which the default pool would refuse as a conflict.
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return {
        name: message_factory.GetMessageClass(
            pool.FindMessageTypeByName(f"{package}.{name}")
        )
        for name in table
    }


def _add_field(
    message: descriptor_pb2.DescriptorProto,
    package: str,
    name: str,
    number: int,
    kind: str,
) -> None:
    """Adds one field of the table to a message's description."""
    field = message.field.add(name=name, number=number)
    field.label = _Field.LABEL_REPEATED if kind[-1] == "*" else _Field.LABEL_OPTIONAL
    base = kind.rstrip("*")
    if base in _SCALARS:
        field.type = _SCALARS[base]
    else:
        field.type = _Field.TYPE_MESSAGE
        field.type_name = f".{package}.{base}"
