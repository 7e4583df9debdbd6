"""A policy's networks as an ONNX graph."""

import numpy as np

import fmpjax
from fmpjax.errors import UserError
from fmpjax.policy import Policy

OPSET, IR = 17, 8  # what runners of 2022 and later read


def check_widths(policy: Policy, terms: dict[str, int]) -> None:
    """Refuse a policy whose parts do not fit together or are not finite.

    Raises:
      UserError: they do not.
    """
    joints = len(policy.joint_names)
    widths = {f"input of layer {i}": kernel.shape[0] for i, kernel in enumerate(policy.kernels)}
    outputs = [kernel.shape[1] for kernel in policy.kernels]
    expected = [sum(terms.values()), *outputs[:-1]]
    checks = list(zip(widths.items(), expected, strict=True))
    checks += [(("normalizer", len(policy.mean)), expected[0]), (("output of the last layer", outputs[-1]), joints)]
    checks += [((name, len(getattr(policy, name))), joints) for name in ("center", "scale", "low", "high")]
    for (name, width), wanted in checks:
        if width != wanted:
            raise UserError(
                f"the policy's {name} has {width} numbers: expected {wanted}, "
                f"for {joints} joints and the observation {policy.observation!r}"
            )
    for name, value in policy._asdict().items():
        arrays = value if name in ("kernels", "biases") else [value] if isinstance(value, np.ndarray) else []
        if not all(np.isfinite(array).all() for array in arrays):
            raise UserError(f"the policy's {name} are not finite: expected numbers")


def graph(policy: Policy):
    """The policy as an ONNX model without metadata: ``obs [1, O]`` to ``actions [1, J]``."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    nodes, constants = [], []

    def constant(name: str, value: np.ndarray | float) -> str:
        constants.append(numpy_helper.from_array(np.asarray(value, np.float32), name))
        return name

    def apply(kind: str, name: str, *inputs: str, **attributes) -> str:
        nodes.append(helper.make_node(kind, inputs, [name], name=f"{kind}_{name}", **attributes))
        return name

    x = apply("Sub", "centered", "obs", constant("mean", policy.mean))
    x = apply("Div", "scaled", x, constant("deviation", policy.deviation))
    x = apply("Clip", "normalized", x, constant("least", -policy.clip), constant("most", policy.clip))
    last = len(policy.kernels) - 1
    for i, (kernel, bias) in enumerate(zip(policy.kernels, policy.biases, strict=True)):
        x = apply("Gemm", f"layer_{i}", x, constant(f"kernel_{i}", kernel), constant(f"bias_{i}", bias))
        if i < last and policy.activation == "swish":
            x = apply("Mul", f"hidden_{i}", x, apply("Sigmoid", f"gate_{i}", x))
        elif i < last:
            x = apply({"relu": "Relu", "elu": "Elu", "tanh": "Tanh"}[policy.activation], f"hidden_{i}", x)
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
