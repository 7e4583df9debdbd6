"""The one error a user may cause."""


class UserError(ValueError):
    """Bad input: one sentence naming the thing, its value and what was expected.

    The command line prints the sentence and exits with code 2; as a library the exception carries it.
    """


# XLA's allocator, a host callback, the CUDA driver and its libraries, Warp.
_OUT_OF_MEMORY = "RESOURCE_EXHAUSTED", "MemoryError", "OUT_OF_MEMORY", "out of memory", "Failed to allocate"


def out_of_memory(error: BaseException) -> bool:
    """Whether an error says that memory ran out, the host's or the device's, at compilation or in a program."""
    return isinstance(error, MemoryError) or (
        isinstance(error, RuntimeError) and any(word in str(error) for word in _OUT_OF_MEMORY)
    )
