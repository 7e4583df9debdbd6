"""The precision of the matrix products of networks."""

import contextlib
import functools
from collections.abc import Generator
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen
from jaxtyping import Float


@contextlib.contextmanager
def at_precision(precision: str) -> Generator[None]:
    """Around what is traced: the precision of its products, as the setting ``precision`` names it."""
    if precision == "default":
        yield
        return
    rounded = precision == "bfloat16"
    with jax.default_matmul_precision("float32"):
        with linen.intercept_methods(_with_rounded_products) if rounded else contextlib.nullcontext():
            yield


def rounded_product(x: Float[jax.Array, "*batch i"], kernel: Float[jax.Array, "i o"]) -> Float[jax.Array, "*batch o"]:
    """``x @ kernel`` of factors that are rounded to bfloat16, summed in float32; so is its gradient in ``x``.

    A product that only names this precision is computed in float32 by XLA on a CPU. Rounded factors reach the
    instructions that some CPUs have for them. The gradient in the kernel has exact factors: XLA gains nothing there.
    """
    return _contract(x.reshape(-1, x.shape[-1]), kernel, 1, 0).reshape(*x.shape[:-1], kernel.shape[-1])


@functools.partial(jax.custom_vjp, nondiff_argnums=(2, 3))
def _contract(a: jax.Array, b: jax.Array, i: int, j: int) -> jax.Array:
    """Sums over axis ``i`` of the matrix ``a`` and axis ``j`` of the matrix ``b``; its axes are the other two."""
    if i == 1:
        a, b = a.astype(jnp.bfloat16), b.astype(jnp.bfloat16)
    return jax.lax.dot_general(a, b, (((i,), (j,)), ((), ())), preferred_element_type=jnp.float32)


def _forward(a, b, i, j):
    return _contract(a, b, i, j), (a, b)


def _backward(i, j, factors, slope):
    a, b = factors
    to_a = (slope, b, 1, 1 - j) if i else (b, slope, 1 - j, 1)
    to_b = (slope, a, 0, 1 - i) if j else (a, slope, 1 - i, 0)
    return _contract(*to_a), _contract(*to_b)


_contract.defvjp(_forward, _backward)


def _with_rounded_products(call, arguments, options, context) -> Any:
    """What flax calls in place of a layer's method."""
    layer = context.module
    if not isinstance(layer, linen.Dense) or context.method_name != "__call__" or layer.is_initializing():
        return call(*arguments, **options)
    params = layer.variables["params"]
    product = rounded_product(*arguments, params["kernel"])
    return product + params["bias"] if layer.use_bias else product
