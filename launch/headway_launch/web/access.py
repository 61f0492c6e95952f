"""Access to the pages: only with the token of this start, and only from the pages themselves."""

import secrets
from collections.abc import Iterable
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from werkzeug.wrappers import Request, Response

if TYPE_CHECKING:
    from _typeshed.wsgi import StartResponse, WSGIApplication, WSGIEnvironment

_REFUSED = "403: open the address that `headway browse` printed; it contains the token of this start.\n"


class TokenAccess:
    """WSGI middleware that refuses requests without the token.

    `/?token=TOKEN` stores the token in a cookie, which all other requests need. Requests from pages of other
    servers, including those on this machine, are refused.
    """

    def __init__(self, application: "WSGIApplication") -> None:
        self.token = secrets.token_urlsafe(32)
        self._application = application
        # Browsers do not keep the cookies of two ports apart.
        self._cookie = f"headway-{secrets.token_hex(4)}"

    def __call__(self, environ: "WSGIEnvironment", start_response: "StartResponse") -> Iterable[bytes]:
        """Answer a request."""
        return self._answer(Request(environ))(environ, start_response)

    def _answer(self, request: Request) -> "WSGIApplication":
        if request.path == "/" and self._is_token(request.args.get("token")):
            # The page loads itself again: after a redirect, browsers withhold the cookie if the address was
            # opened from a page of another server, such as a web terminal.
            response = Response(headers={"Refresh": "0; url=/", "Referrer-Policy": "no-referrer"})
            response.set_cookie(self._cookie, self.token, httponly=True, samesite="Strict")
            return response
        origin = request.headers.get("Origin")
        if self._is_token(request.cookies.get(self._cookie)) and (
            origin is None or urlsplit(origin).netloc == request.host
        ):
            return self._application
        return Response(_REFUSED, status=403)

    def _is_token(self, text: str | None) -> bool:
        return text is not None and secrets.compare_digest(text.encode(), self.token.encode())
