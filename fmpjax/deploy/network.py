"""A policy's networks as an ONNX graph."""

from collections.abc import Sequence

import numpy as np

import fmpjax
from fmpjax.errors import UserError
from fmpjax.policy import LAYERED, Policy

OPSET, IR = 17, 8  # what runners of 2022 and later read


def check_widths(policy: Policy, terms: dict[str, int]) -> None:
    """Refuse a policy whose parts do not fit together or are not finite.

    Raises:
      UserError: they do not.
    """
    joints = len(policy.joint_names)
    observed, estimated, estimator = sum(terms.values()), 0, policy.estimator_kernels
    checks = []
    if estimator:
        checks, estimated = _inputs("layer {} of the estimator", estimator, observed), estimator[-1].shape[1]
    checks += _inputs("layer {}", policy.kernels, (policy.inputs.size or observed) + estimated)
    checks += [(("normalizer", len(policy.mean)), observed)]
    checks += [(("output of the last layer", policy.kernels[-1].shape[1]), joints)]
    checks += [((name, len(getattr(policy, name))), joints) for name in ("center", "scale", "low", "high")]
    for (name, width), wanted in checks:
        if width != wanted:
            raise UserError(
                f"the policy's {name} has {width} numbers: expected {wanted}, "
                f"for {joints} joints and the observation {policy.observation!r}"
            )
    for name, value in policy._asdict().items():
        arrays = value if name in LAYERED else [value] if isinstance(value, np.ndarray) else []
        if not all(np.isfinite(array).all() for array in arrays):
            raise UserError(f"the policy's {name} are not finite: expected numbers")


def _inputs(name: str, kernels: Sequence[np.ndarray], first: int) -> list[tuple[tuple[str, int], int]]:
    """What each layer takes, and what it should: as many numbers as the layer before it gives."""
    expected = [first, *(kernel.shape[1] for kernel in kernels[:-1])]
    found = [(f"input of {name.format(i)}", kernel.shape[0]) for i, kernel in enumerate(kernels)]
    return list(zip(found, expected, strict=True))


def graph(policy: Policy):
    """The policy as an ONNX model without metadata: ``obs [1, O]`` to ``actions [1, J]``."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    nodes, constants = [], []

    def constant(name: str, value: np.ndarray | float, kind: type = np.float32) -> str:
        constants.append(numpy_helper.from_array(np.asarray(value, kind), name))
        return name

    def apply(kind: str, name: str, *inputs: str, **attributes) -> str:
        nodes.append(helper.make_node(kind, inputs, [name], name=f"{kind}_{name}", **attributes))
        return name

    def network(x: str, kernels: Sequence[np.ndarray], biases: Sequence[np.ndarray], of: str = "") -> str:
        last = len(kernels) - 1
        for i, (kernel, bias) in enumerate(zip(kernels, biases, strict=True)):
            x = apply("Gemm", f"{of}layer_{i}", x, constant(f"{of}kernel_{i}", kernel), constant(f"{of}bias_{i}", bias))
            if i < last and policy.activation == "swish":
                x = apply("Mul", f"{of}hidden_{i}", x, apply("Sigmoid", f"{of}gate_{i}", x))
            elif i < last:
                x = apply({"relu": "Relu", "elu": "Elu", "tanh": "Tanh"}[policy.activation], f"{of}hidden_{i}", x)
        return x

    x = apply("Sub", "centered", "obs", constant("mean", policy.mean))
    x = apply("Div", "scaled", x, constant("deviation", policy.deviation))
    x = apply("Clip", "normalized", x, constant("least", -policy.clip), constant("most", policy.clip))
    if policy.estimator_kernels:
        estimate = network(x, policy.estimator_kernels, policy.estimator_biases, "estimator_")
        if policy.inputs.size:
            x = apply("Gather", "newest", x, constant("inputs", policy.inputs, np.int64), axis=1)
        x = apply("Concat", "informed", x, estimate, axis=1)
    x = network(x, policy.kernels, policy.biases)
    # The limits of the joint targets, in units of action: a runner that knows no limits keeps them all the same.
    x = apply("Max", "above", x, constant("lowest", (policy.low - policy.center) / policy.scale))
    apply("Min", "actions", x, constant("highest", (policy.high - policy.center) / policy.scale))

    def tensor(name: str, width: int):
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, width])

    body = helper.make_graph(
        nodes, "policy", [tensor("obs", len(policy.mean))], [tensor("actions", len(policy.joint_names))], constants
    )
    return helper.make_model(
        body,
        producer_name="fmpjax",
        producer_version=fmpjax.__version__,
        opset_imports=[onnx.helper.make_opsetid("", OPSET)],
        ir_version=IR,
    )
