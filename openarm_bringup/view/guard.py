# SPDX-License-Identifier: Apache-2.0
"""Authorisation for a server that moves a robot: a token a run, the host name of the request, the page it comes from.

A browser lets any page of the internet send requests to this machine. What keeps such a page out: it does not know the
token; its `Origin` is not ours; and a name of its own that it makes point here (DNS rebinding) is none of our names.
"""

from __future__ import annotations

import hmac
import ipaddress
import re
import secrets
import socket
from collections.abc import Iterable

from openarm_common.errors import Code, OpenArmError

LOOPBACK = "127.0.0.1"
_HOST = re.compile(r"(\[(?P<address>[0-9a-f:.]+)\]|(?P<name>[a-z0-9._-]+))(:\d+)?")
_LOCAL_NAMES = frozenset({"localhost", LOOPBACK, "::1"})


class Guard:
    """Decides about requests; made once a run.

    Args:
        host: Address or name that the server listens on.
        origins: Pages of others that may speak to it too, such as `https://app.example.org`.
        token: Token that a caller must know; a new one by default.
    """

    def __init__(self, host: str = LOOPBACK, *, origins: Iterable[str] = (), token: str | None = None) -> None:
        self.token = secrets.token_urlsafe(24) if token is None else token
        if len(self.token) < 16:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"the token has {len(self.token)} letters, expected at least 16")
        self.loopback = _is_loopback(host)
        self._origins = frozenset(origins)
        self._names = _LOCAL_NAMES if self.loopback else _LOCAL_NAMES | {host.lower(), socket.gethostname().lower()}

    def check_host(self, host: str | None) -> None:
        """Refuse a request that was sent to another name.

        Args:
            host: The header `Host`.

        Raises:
            OpenArmError: INVALID_ARGUMENT.
        """
        name = _host_name(host or "")
        # A rebound name is never an address: whoever asks for an address means this machine.
        if name in self._names or (not self.loopback and _is_address(name)):
            return
        names = ", ".join(sorted(self._names))
        raise _refused(f"this server was called {name or 'by no name'!r}; it answers to {names}")

    def check_origin(self, origin: str | None, host: str | None) -> None:
        """Refuse what a page of others asks for.

        Args:
            origin: The header `Origin`, which browsers send with all that changes something, and with every websocket.
            host: The header `Host`, already checked.

        Raises:
            OpenArmError: INVALID_ARGUMENT.
        """
        if origin in self._origins or (host and origin in (f"http://{host}", f"https://{host}")):
            return
        page = f"the page {origin!r}" if origin else "a request without an origin"
        raise _refused(f"{page} may not ask; open the address that was printed")

    def check_token(self, token: str | None) -> None:
        """Refuse a request without the token.

        Raises:
            OpenArmError: INVALID_ARGUMENT.
        """
        if not hmac.compare_digest((token or "").encode(), self.token.encode()):
            what = "wrong token" if token else "no token"
            raise _refused(f"{what}; open the whole address that was printed when the server started")


def _refused(why: str) -> OpenArmError:
    return OpenArmError(Code.INVALID_ARGUMENT, why)


def _host_name(host: str) -> str:
    match = _HOST.fullmatch(host.lower())
    return match["address"] or match["name"] if match else ""


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _is_loopback(host: str) -> bool:
    return host in _LOCAL_NAMES or (_is_address(host) and ipaddress.ip_address(host).is_loopback)
