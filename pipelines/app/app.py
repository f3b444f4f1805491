"""`sdps app`: local web pages for photographs, scenes to play with, and data."""

import argparse
import importlib.util
import signal
import sys
import threading
import webbrowser
from pathlib import Path

from pipelines.app.common.uploads import Limits
from render.shared.errors import InputError

_NEEDED = ("starlette", "uvicorn")
_LOCAL = ("127.0.0.1", "localhost", "::1")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps app`."""
    limits = Limits()
    parser.add_argument("folder", type=Path, nargs="?", default=Path("out"),
                        help="folder that the page Data and runs shows (default: %(default)s)")  # fmt: skip
    parser.add_argument("--port", type=int, default=7870, help="port (default: %(default)s; 0 for any free one)")
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (default: only this machine)")
    parser.add_argument("--no-browser", action="store_true", help="do not open a browser")
    parser.add_argument(
        "--max-files", type=int, default=limits.files, help="files in one upload (default: %(default)s)"
    )
    parser.add_argument("--max-megabytes", type=int, default=limits.bytes // 2**20,
                        help="total size of one visitor's uploads, unpacked (default: %(default)s)")  # fmt: skip
    parser.add_argument("--max-megapixels", type=float, default=limits.pixels / 1e6,
                        help="pixels of one picture, in millions (default: %(default)s)")  # fmt: skip


def main(args: argparse.Namespace) -> int:
    """Serve the pages until Ctrl-C."""
    missing = [name for name in _NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(f"{' and '.join(missing)} missing: pip install sdps[app]")
    limits = _read_limits(args)
    import uvicorn

    from pipelines.app.server import build

    app = build(args.folder, limits, args.host)
    config = uvicorn.Config(app, host=args.host, port=args.port, log_level="warning", server_header=False)
    try:
        socket = config.bind_socket()
    except SystemExit as error:
        app.state.close()
        raise InputError(f"--host {args.host} --port {args.port}: cannot be used; choose another --port") from error
    address = f"http://{args.host if ':' not in args.host else f'[{args.host}]'}:{socket.getsockname()[1]}/"
    sys.stdout.write(f"{address}   (Ctrl-C stops it)\n")
    if args.host not in _LOCAL:
        sys.stdout.write("anyone who can reach this address can use the app and see what is in the folder\n")
    sys.stdout.flush()
    if not args.no_browser:
        threading.Timer(1.0, webbrowser.open, [address]).start()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that the clean-up below also happens then
    try:
        uvicorn.Server(config).run(sockets=[socket])
    except KeyboardInterrupt:
        pass
    finally:
        app.state.close()
    return 0


def _read_limits(args: argparse.Namespace) -> Limits:
    for name in ("max_files", "max_megabytes", "max_megapixels"):
        if not getattr(args, name) > 0:
            raise InputError(f"--{name.replace('_', '-')}: must be above 0, got {getattr(args, name)}")
    if not 0 <= args.port <= 65535:
        raise InputError(f"--port: must be 0 to 65535, got {args.port}")
    return Limits(
        files=args.max_files, bytes=args.max_megabytes * 2**20, pixels=round(args.max_megapixels * 1e6)
    )  # fmt: skip
