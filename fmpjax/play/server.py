"""The server of a page: viser's, on this machine alone unless another address is named."""

import contextlib
import io
import socket
from collections.abc import Generator

import viser

from fmpjax.errors import UserError

HOST, PORT = "127.0.0.1", 8080
WIDTH = 300  # px, of the panel on the left


class Server(viser.ViserServer):
    """viser's server without its tunnel, by which a page could be opened to the internet."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Refuse: to let others see the page, name an address."""
        return None

    def stop(self) -> None:
        """Close the page."""
        with contextlib.redirect_stdout(io.StringIO()):  # viser says so by itself
            super().stop()


@contextlib.contextmanager
def beside(server: viser.ViserServer, title: str) -> Generator[None]:
    """A separate panel on the left of a page, for what is added to the page within."""
    panel = server.gui.add_panel()
    with panel.add_tab(title):
        yield
    panel.dock_left()
    panel.set_width(WIDTH)


def free_port(host: str, port: int) -> int:
    """The port itself, or one that is free for 0.

    Raises:
      UserError: the address is not this machine's, or the port is taken.
    """
    if not 0 <= port < 2**16:
        raise UserError(f"--port is {port}: expected 0 to {2**16 - 1}")
    # viser takes the next free port in silence, and looks for ever for one of an address that is not ours.
    try:
        (family, kind, protocol, _, address), *_ = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
            return probe.getsockname()[1]
    except socket.gaierror:
        raise UserError(f"--host is {host!r}: expected an address of this machine") from None
    except OSError as error:
        raise UserError(
            f"no page at {host}:{port} ({error.strerror}): name another --port, or 0 for any, and an address of this "
            "machine as --host"
        ) from None


def start(title: str, host: str = HOST, port: int = PORT) -> Server:
    """Serve an empty page.

    Args:
      title: of its panel.
      host: address to listen at.
      port: of it; 0 for any that is free.

    Raises:
      UserError: the address is not this machine's, or the port is taken.
    """
    port = free_port(host, port)
    with contextlib.redirect_stdout(io.StringIO()):  # viser prints a box
        server = Server(host=host, port=port, label=title, verbose=False)
    if server.get_port() != port:
        server.stop()
        raise UserError(f"port {port} was just taken: name another --port, or 0 for any")
    server.gui.configure_theme(
        control_width="large", show_logo=False, show_share_button=False, brand_color=(42, 111, 176)
    )
    server.gui.main_panel.dock_right()  # where it floats it hides the robot on a small screen
    return server
