"""Change ONNX graphs: loops read constants from outside, and the graph of one sample becomes that of a batch."""

from __future__ import annotations

import importlib
from typing import Any


def hoist_constants(graph: Any, names: dict[str, str] | None = None) -> int:
    """Let loops read what they only pass on from the enclosing graph, in place; return how many values that were.

    A converter of a scan passes constants from one iteration to the next, and ONNX Runtime copies them every time: all
    weights of a network. In ONNX a loop's body may read values of the enclosing graph directly.

    Args:
      graph: an `onnx.GraphProto`.
      names: new names of values that the graph reads.
    """
    hoisted = 0
    read = {name for node in graph.node for name in node.input} | {output.name for output in graph.output}
    for node in graph.node:
        if names:
            node.input[:] = [names.get(name, name) for name in node.input]
        for attribute in node.attribute:
            if attribute.HasField("g"):
                inner = dict(names or {})
                if node.op_type == "Loop":
                    fixed = [i for i in _invariant(attribute.g) if node.output[i] not in read]
                    inner |= _remove(node, attribute.g, fixed)
                    hoisted += len(fixed)
                hoisted += hoist_constants(attribute.g, inner)
    return hoisted


def remove_unused(graph: Any) -> None:
    """Remove initializers that nothing reads, in place, from a graph and its bodies."""
    read = set(_read(graph))
    kept = [one for one in graph.initializer if one.name in read]
    del graph.initializer[:]
    graph.initializer.extend(kept)
    for node in graph.node:
        for attribute in node.attribute:
            if attribute.HasField("g"):
                remove_unused(attribute.g)


def map_leading(graph: Any, names: dict[str, str], symbol: str) -> None:
    """Map a graph over a new leading axis of some of its inputs and of all outputs, in place, by one Scan.

    Constants and the other inputs are read from outside of it.

    Args:
      graph: an `onnx.GraphProto`.
      names: new names of the inputs and outputs that get the axis.
      symbol: the name of its size.
    """
    helper = importlib.import_module("onnx").helper

    def mapped(one: Any) -> Any:
        if one.name not in names:
            return one
        dims = one.type.tensor_type.shape.dim
        shape = [dim.dim_value if dim.HasField("dim_value") else dim.dim_param or None for dim in dims]
        return helper.make_tensor_value_info(names[one.name], one.type.tensor_type.elem_type, [symbol, *shape])

    samples = [one for one in graph.input if one.name in names]
    inputs, outputs = [mapped(one) for one in graph.input], [mapped(one) for one in graph.output]
    body = helper.make_graph(graph.node, "sample", samples, graph.output, value_info=graph.value_info)
    read, made = [names[one.name] for one in samples], [one.name for one in outputs]
    scan = helper.make_node("Scan", read, made, body=body, num_scan_inputs=len(samples))
    graph.CopyFrom(helper.make_graph([scan], graph.name, inputs, outputs, graph.initializer))


def _read(graph: Any) -> list[str]:
    """Return the names that a graph and its bodies read."""
    names = [output.name for output in graph.output]
    for node in graph.node:
        names += node.input
        for attribute in node.attribute:
            names += _read(attribute.g) if attribute.HasField("g") else []
    return names


def _invariant(body: Any) -> list[int]:
    """Return which carried values of a loop's body leave it as they entered."""
    source = {node.output[0]: node.input[0] for node in body.node if node.op_type == "Identity"}
    found: list[int] = []
    # Inputs are the iteration, the condition and the carried values; outputs the condition and the carried values.
    for i, (before, after) in enumerate(zip(body.input[2:], body.output[1:], strict=False)):
        name = after.name
        while name in source and name != before.name:
            name = source[name]
        if name == before.name:
            found.append(i)
    return found


def _remove(loop: Any, body: Any, fixed: list[int]) -> dict[str, str]:
    """Remove carried values from a loop; return the outer name of each that its body reads."""
    names = {body.input[2 + i].name: loop.input[2 + i] for i in fixed}
    removed = {body.output[1 + i].name for i in fixed}
    kept = [node for node in body.node if not (node.op_type == "Identity" and node.output[0] in removed)]
    del body.node[:]
    body.node.extend(kept)
    for i in reversed(fixed):
        del body.input[2 + i]
        del body.output[1 + i]
        del loop.input[2 + i]
        # The value after the loop is the value before it.
        del loop.output[i]
    return names
