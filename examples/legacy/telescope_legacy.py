#!/usr/bin/env python3
"""Connects a robot with an old Python to Telescope: one file, standard library only, Linux, Python 3.6 or newer.

    python3 telescope_legacy.py enroll --url https://telescope.example --name qbo     # prints the claim code
    python3 telescope_legacy.py run --movements ./movements

Each file in the folder is a behaviour of the device: ``wave.py`` runs as ``wave``. As a library:

    robot = telescope_legacy.Robot()
    robot.on("wave", lambda action: arm.wave(until=action.ended))
    robot.run()

The wrapper executes only what is installed on the robot, and only for commands that the cloud has signed.
"""

import argparse
import base64
import binascii
import collections
import contextlib
import fcntl
import hashlib
import http.client
import json
import logging
import os
import random
import re
import signal
import socket
import ssl
import subprocess
import sys
import threading
import time
import urllib.parse

SOFTWARE = "telescope-legacy 1"
HOME = os.path.join(os.path.expanduser("~"), ".telescope-legacy")
ID = re.compile(r"\A[A-Za-z0-9_-]{1,64}\Z")
WITH_PARAMETERS = ("say", "drive", "go_to", "look_at", "move_joints", "move_pose", "set_stiffness")
"""Requests with parameters that a function or a file of this name can execute; all other names are behaviours."""
AUTHORITY = (
    "grant_lease",
    "release_lease",
    "ask_lease",
    "drop_request",
    "cancel_action",
    "stop_device",
    "reset_stop",
    "follow_key",
)
TERMINAL = ("done", "failed", "expired", "cancelled")
MAX_TEXT, MAX_RESULT = 2000, 32000
KEEP_MS = 8 * 24 * 3600 * 1000
"""Commands are remembered for longer than any time to live, and than the cloud asks for their outcome."""
LONG_POLL_S, BUSY_POLL_S, RESPONSE_S = 25.0, 1.0, 4.0
"""Polls are short while an action runs, so that a lost connection is detected, and while an answer is not stored yet:
the cloud may repeat this command."""
log = logging.getLogger("telescope")


class LegacyError(Exception):
    """An error that the text explains to the user."""


class CloudError(Exception):
    """The cloud rejected a request. ``passing``: a later attempt may succeed."""

    def __init__(self, message, code="", passing=False):
        super().__init__(message)
        self.code, self.passing = code, passing


class Refused(Exception):  # noqa: N818 (a regular outcome)
    """A command is not executed: code and message for the caller."""

    def __init__(self, code, message):
        super().__init__(message)
        self.code = code


# ---------------------------------------------------------------- Ed25519 (RFC 8032)

P = 2**255 - 19
ORDER = 2**252 + 27742317777372353535851937790883648493
D = -121665 * pow(121666, P - 2, P) % P
SQRT_MINUS_1 = pow(2, (P - 1) // 4, P)
NEUTRAL = (0, 1, 1, 0)


def _add(one, other):
    """Sum of two points in extended coordinates x, y, z, t with t = x y / z. The formula has no exceptions."""
    a = (one[1] - one[0]) * (other[1] - other[0]) % P
    b = (one[1] + one[0]) * (other[1] + other[0]) % P
    c = 2 * one[3] * other[3] * D % P
    d = 2 * one[2] * other[2] % P
    e, f, g, h = b - a, d - c, d + c, b + a
    return e * f % P, g * h % P, f * g % P, e * h % P


def _multiply(point, scalar):
    """Multiple of a point. The number of additions does not depend on the scalar, which may be secret."""
    low, high = NEUTRAL, point
    for bit in reversed(range(256)):
        middle = _add(low, high)
        low, high = (middle, _add(high, high)) if scalar >> bit & 1 else (_add(low, low), middle)
    return low


def _encode(point):
    inverse = pow(point[2], P - 2, P)
    x, y = point[0] * inverse % P, point[1] * inverse % P
    return (y | (x & 1) << 255).to_bytes(32, "little")


def _decode(data):
    """The point that 32 bytes encode, or ``None``: each point has exactly one valid encoding."""
    number = int.from_bytes(data, "little")
    y, odd = number & (1 << 255) - 1, number >> 255
    if len(data) != 32 or y >= P:
        return None
    square = (y * y - 1) * pow(D * y * y + 1, P - 2, P) % P
    x = pow(square, (P + 3) // 8, P)
    if x * x % P != square:
        x = x * SQRT_MINUS_1 % P
    if x * x % P != square or (x == 0 and odd):
        return None
    x = x if x & 1 == odd else P - x
    return x, y, 1, x * y % P


BASE = _decode((4 * pow(5, P - 2, P) % P).to_bytes(32, "little"))


def _hash(*parts):
    return int.from_bytes(hashlib.sha512(b"".join(parts)).digest(), "little")


def _secret(seed):
    digest = hashlib.sha512(seed).digest()
    return int.from_bytes(digest[:32], "little") & (1 << 254) - 8 | 1 << 254, digest[32:]


def public_key(seed):
    """The public key (32 bytes) of a private key (32 random bytes)."""
    return _encode(_multiply(BASE, _secret(seed)[0]))


def sign(seed, public, message):
    """The signature (64 bytes) of a message with the private key ``seed``."""
    secret, prefix = _secret(seed)
    nonce = _hash(prefix, message) % ORDER
    point = _encode(_multiply(BASE, nonce))
    return point + ((nonce + _hash(point, public, message) * secret) % ORDER).to_bytes(32, "little")


def verify(public, message, signature):
    """Whether ``public`` signed the message. Keys of small order, other encodings and lengths are rejected."""
    point = _decode(public)
    if point is None or len(signature) != 64 or _encode(_multiply(point, 8)) == _encode(NEUTRAL):
        return False
    scalar = int.from_bytes(signature[32:], "little")
    if scalar >= ORDER:
        return False
    negative = (P - point[0], point[1], 1, P - point[3])
    challenge = _hash(signature[:32], public, message) % ORDER
    return _encode(_add(_multiply(BASE, scalar), _multiply(negative, challenge))) == signature[:32]


def to_text(data):
    """Base64url without padding."""
    return base64.urlsafe_b64encode(data).rstrip(b"=").decode()


def from_text(text):
    """Decode the only base64url text of some bytes. Raises ``ValueError``."""
    try:
        data = base64.b64decode(text + "=" * (-len(text) % 4), altchars=b"-_", validate=True)
    except (binascii.Error, TypeError) as error:
        raise ValueError("not base64url") from error
    if to_text(data) != text:
        raise ValueError("not base64url")
    return data


def key_id(public_text):
    """Short id of a public key in base64url."""
    return hashlib.sha256(public_text.encode()).hexdigest()[:16]


# ---------------------------------------------------------------- files


def write_private(path, text):
    """Replace a file that only its owner can read; after a crash it has the old or the new content."""
    try:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(path + ".new")
        with open(os.open(path + ".new", os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        os.replace(path + ".new", path)
        folder = os.open(os.path.dirname(path), os.O_RDONLY)
        os.fsync(folder)
        os.close(folder)
    except OSError as error:
        raise LegacyError(f"{path} cannot be written: {error}") from error


class Journal:
    """Values by key that survive a crash: each change is one line, on disk when ``put`` returns."""

    def __init__(self, path):
        self._path, self._file, self.values = path, None, {}
        lines = []
        with contextlib.suppress(FileNotFoundError), open(path, encoding="utf-8") as file:
            lines = file.read().split("\n")
        for number, line in enumerate(lines[:-1], 1):  # a crash leaves an incomplete line only at the end
            try:
                self._merge(json.loads(line))
            except (ValueError, AttributeError) as error:
                raise LegacyError(
                    f"line {number} of {path} is damaged; move the file away only after you have checked the robot, "
                    "because it records which commands have run"
                ) from error
        self._rewrite()

    def put(self, changes):
        """Store values; ``None`` deletes one."""
        line = json.dumps(changes, allow_nan=False) + "\n"
        try:
            self._file.write(line)
            self._file.flush()
            os.fsync(self._file.fileno())
        except OSError as error:
            raise LegacyError(f"{self._path} cannot be written: {error}") from error
        self._merge(changes)
        self._size += len(line)
        if self._size > 1000000:
            self._rewrite()

    def close(self):
        """Close the file."""
        if self._file is not None:
            self._file.close()

    def _merge(self, changes):
        self.values.update(changes)
        for key in [key for key, value in changes.items() if value is None]:
            del self.values[key]

    def _rewrite(self):
        self.close()
        write_private(self._path, json.dumps(self.values) + "\n")
        self._file, self._size = open(self._path, "a", encoding="utf-8"), 0  # noqa: SIM115 (kept open)


# ---------------------------------------------------------------- cloud


class Cloud:
    """Client of the HTTP API, and the estimate of the cloud's clock. Usable by several threads."""

    def __init__(self, url, seed, ca=None):
        self._url = urllib.parse.urlsplit(url)
        if self._url.scheme not in ("http", "https") or not self._url.hostname:
            raise LegacyError(f"'{url}' is not an address such as https://telescope.example")
        self._seed, self._public = seed, public_key(seed)
        self._tls = ssl.create_default_context(cafile=ca) if self._url.scheme == "https" else None
        self._lock = threading.Lock()
        self._token, self._token_s, self._polling = "", float("-inf"), None
        self._offset_ms, self._error_ms, self._measured_s = 0.0, float("inf"), 0.0

    def now_ms(self):
        """The cloud's time [ms since 1970], or ``None`` before the first response."""
        return None if self._error_ms == float("inf") else time.monotonic() * 1000 + self._offset_ms

    def call(self, method, path, body=None, timeout_s=10.0):
        """The JSON response. Raises ``CloudError``, or ``OSError`` if the cloud does not respond."""
        known = self.now_ms() is not None
        try:
            return self._call(method, path, body, timeout_s)
        except CloudError as error:
            if error.code != "unauthorized" or known or self.now_ms() is None:
                raise
            self._token_s = float("-inf")  # the clock of this robot is wrong: use the cloud's
            return self._call(method, path, body, timeout_s)

    def _call(self, method, path, body, timeout_s):
        host, port = self._url.hostname, self._url.port
        if self._tls is None:
            connection = http.client.HTTPConnection(host, port, timeout=timeout_s)
        else:
            connection = http.client.HTTPSConnection(host, port, timeout=timeout_s, context=self._tls)
        if "wait_ms" in path:
            self._polling = connection
        headers = {"Authorization": "Bearer " + self._bearer(), "Content-Type": "application/json"}
        content = None if body is None else json.dumps(body, allow_nan=False).encode()
        sent_s = time.monotonic()
        with contextlib.closing(connection):
            try:
                connection.request(method, self._url.path.rstrip("/") + "/api/v1" + path, content, headers)
                response = connection.getresponse()
                text, server_ms = response.read(4000000), response.getheader("X-Telescope-Time-Ms", "")
            except http.client.HTTPException as error:
                raise OSError(f"{self._url.geturl()} sent no valid response") from error
        if server_ms.isdigit() and "wait_ms" not in path:
            self._observe(int(server_ms), sent_s, time.monotonic())
        try:
            answer = json.loads(text.decode()) if text else {}
            message, code = answer.get("detail") or answer.get("title"), str(answer.get("type")).rpartition("/")[2]
        except (ValueError, AttributeError, RecursionError):
            raise CloudError(
                f"{self._url.geturl()} responded {response.status} without JSON: is it a Telescope server?",
                passing=response.status >= 500,
            ) from None
        if response.status >= 300:
            raise CloudError(str(message), code, passing=response.status >= 500 or response.status == 429)
        return answer

    def abort_poll(self):
        """End a waiting poll, which raises ``OSError``. Callable from any thread and from signal handlers."""
        with contextlib.suppress(OSError, AttributeError):
            self._polling.sock.shutdown(socket.SHUT_RDWR)

    def _observe(self, server_ms, sent_s, received_s):
        """Keep the most precise estimate; one that contradicts it replaces it, because the cloud's clock was set."""
        error_ms = max(0.5, (received_s - sent_s) * 500)
        offset_ms = server_ms - (sent_s + received_s) * 500
        aged_ms = self._error_ms + (received_s - self._measured_s) * 0.05
        with self._lock:
            if error_ms <= aged_ms or abs(offset_ms - self._offset_ms) > error_ms + aged_ms:
                self._offset_ms, self._error_ms, self._measured_s = offset_ms, error_ms, received_s

    def _bearer(self):
        with self._lock:
            if time.monotonic() - self._token_s > 20:  # a signature takes some time on an old processor
                now = int((self.now_ms() or time.time() * 1000) / 1000)
                header = {"alg": "EdDSA", "typ": "JWT", "kid": key_id(to_text(self._public))}
                claims = {"iss": "agent", "aud": "telescope/api", "iat": now, "exp": now + 60}
                claims["jti"] = to_text(os.urandom(16))
                text = ".".join(to_text(json.dumps(part).encode()) for part in (header, claims))
                self._token = text + "." + to_text(sign(self._seed, self._public, text.encode()))
                self._token_s = time.monotonic()
            return self._token


def parse_envelope(payload, keys, context):
    """The body of a signed message: parsed JSON. The signature covers the exact text of the body.

    ``keys``: valid public keys by id, in base64url. Raises ``Refused``.
    """
    fields, decoder = {}, json.JSONDecoder(parse_constant=_reject_constant)
    space = re.compile(r"[ \t\r\n]*")
    try:
        position = space.match(payload).end()
        separator, position = payload[position], position + 1
        while separator != "}":
            name, position = decoder.raw_decode(payload, space.match(payload, position).end())
            colon = space.match(payload, position).end()
            start = space.match(payload, colon + 1).end()
            value, position = decoder.raw_decode(payload, start)
            if payload[colon] != ":" or name in fields:
                raise ValueError("not an object")
            fields[name] = value, payload[start:position].encode()
            position = space.match(payload, position).end()
            separator, position = payload[position], position + 1
            if separator not in ",}":
                raise ValueError("not an object")
        (body, text), name, signature = fields["body"], fields["key"][0], fields["signature"][0]
        public = keys.get(name)
        genuine = public is not None and verify(from_text(public), context + text, from_text(signature))
    except (ValueError, KeyError, IndexError, TypeError, RecursionError, AttributeError) as error:
        raise Refused("malformed", f"not a signed message: {error}") from error
    if not genuine:
        raise Refused("bad_signature", "the signature is not of a key that this robot has pinned")
    return body


def _reject_constant(name):
    raise ValueError(name + " is not a number")


# ---------------------------------------------------------------- actions


class Action:
    """A running action, as functions see it. A function must return soon after ``ended`` is set.

    Attributes:
        name: Name of the behaviour, or the kind of a request with parameters.
        parameters: Parameters of the request.
        ended: Set by a cancel, Stop, the time limit, and a lost connection or lease.
    """

    def __init__(self, command, name, parameters):
        self.command, self.name, self.parameters, self.ended = command, name, parameters, threading.Event()
        self.reported, self.reported_s = "", 0.0
        self.output, self.started_s, self.why, self.ended_s, self.late = "", time.monotonic(), None, 0.0, False

    def print(self, text):
        """Add output; the newest 2,000 characters are kept."""
        self.output = (self.output + str(text).encode("utf-8", "replace").decode())[-MAX_TEXT:]

    def end(self, status, code, message):
        """Ask the function to return. The first reason counts."""
        if self.why is None:
            self.why, self.ended_s = (status, code, message), time.monotonic()
        self.ended.set()


class Script:
    """Runs a file in processes of its own, with the parameters as JSON in the last argument.

    A guard process kills all of them when this program is killed. They keep ``lock``, so that no other run can start
    while one of them exists. A file that is not executable runs with this Python.
    """

    def __init__(self, path, grace_s, lock):
        if os.stat(path).st_mode & 0o002:
            raise LegacyError(f"{path} can be changed by every user of this machine; run: chmod o-w")
        self._command = [path] if os.access(path, os.X_OK) else [sys.executable, path]
        self._folder, self._grace_s, self._lock = os.path.dirname(path), grace_s, lock

    def __call__(self, action):
        lock = self._lock()
        guard = [sys.executable, os.path.abspath(__file__), "guard", str(lock), str(self._grace_s)]
        process = subprocess.Popen(
            guard + self._command + [json.dumps(action.parameters)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            cwd=self._folder,
            env=dict(os.environ, PYTHONUNBUFFERED="1"),
            start_new_session=True,
            pass_fds=(lock,),
        )
        reader = threading.Thread(target=self._read, args=(process.stdout, action))
        reader.start()
        # WNOWAIT: the number of the process group stays reserved until ``wait``.
        while os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
            if action.ended.wait(0.02):
                os.killpg(process.pid, signal.SIGTERM)
                self._wait(process.pid)
                break
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)  # also processes that the script has left behind
        code = process.wait()
        reader.join()
        process.stdin.close()
        if code:
            raise RuntimeError(f"the script ended with code {code}")

    def _wait(self, process):
        end_s = time.monotonic() + self._grace_s
        while time.monotonic() < end_s and os.waitid(os.P_PID, process, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
            time.sleep(0.02)

    @staticmethod
    def _read(stream, action):
        with stream:
            for data in iter(lambda: os.read(stream.fileno(), 4096), b""):
                action.print(data.decode("utf-8", "replace"))


def guard(lock, grace_s, command):
    """Run a command, and end its process group when standard input, held by the wrapper, is closed."""
    signal.signal(signal.SIGTERM, lambda *_: None)  # for the script only: the guard reports its exit code

    orphaned = threading.Event()

    def end_with_wrapper():
        sys.stdin.buffer.read()
        orphaned.set()
        os.killpg(os.getpgrp(), signal.SIGTERM)
        time.sleep(float(grace_s))
        os.killpg(os.getpgrp(), signal.SIGKILL)

    try:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, pass_fds=(int(lock),))
    except OSError as error:
        print(f"cannot be started: {error}", flush=True)
        return 127
    threading.Thread(target=end_with_wrapper, daemon=True).start()
    code = process.wait()
    if orphaned.is_set():
        signal.pause()  # until the other processes of the script are killed too
    os._exit(code if code >= 0 else 128 - code)


# ---------------------------------------------------------------- robot


class Robot:
    """One robot. ``run`` blocks until ``stop`` or an error; functions run in a thread, one at a time.

    Args:
        home: Folder of the key, the pairing and the journal, written by ``enroll``.
        lost_after_s: Without a response of the cloud for this time [s], the running action is stopped.
        max_s: Time limit of each action [s].
        grace_s: Time between SIGTERM and SIGKILL [s] for scripts.
        report_s: Period of reports of response times to the cloud [s].
    """

    def __init__(self, home=HOME, *, lost_after_s=5.0, max_s=600.0, grace_s=0.5, report_s=60.0):
        self._home, self._config = home, load_config(home)
        self._lost_after_s, self._max_s, self._grace_s, self._report_s = lost_after_s, max_s, grace_s, report_s
        self._cloud = Cloud(self._config["url"], bytes.fromhex(self._config["seed"]), self._config["ca"])
        self._functions = {}
        self._lock = threading.RLock()
        self._wake, self._stopping, self._finished = threading.Event(), threading.Event(), threading.Event()
        self._action = self._latch = self._lease = self._request = self._error = None
        self._have, self._sequences, self._stops, self._rejected_s = {}, {}, [], {}
        self._outbox, self._samples = collections.deque(), collections.deque(maxlen=100)
        self._up, self._contact_s, self._state_s, self._reported_s = False, 0.0, 0.0, time.monotonic()
        self._state_due = self._announced = False

    def on(self, name, function):
        """Register ``function(action)``: for the behaviour ``name``, or for a kind in ``WITH_PARAMETERS``.

        The result is ``None`` or a dictionary; an exception ends the action as failed.
        """
        if not ID.match(name):
            raise LegacyError(f"'{name}' is not a name: use letters, digits, _ and -")
        if name in self._functions:
            raise LegacyError(f"two movements have the name '{name}'")
        self._functions[name] = function
        return self

    def on_files(self, folder):
        """Register each file of a folder under its name without suffix; names that start with . or _ are skipped."""
        for entry in sorted(os.listdir(folder)):
            path = os.path.join(os.path.abspath(folder), entry)
            if entry[0] not in "._" and os.path.isfile(path) and (entry.endswith(".py") or os.access(path, os.X_OK)):
                self.on(os.path.splitext(entry)[0], Script(path, self._grace_s, self._lock_file))
        return self

    def _lock_file(self):
        return self._running.fileno()

    def stop(self):
        """End ``run``, from any thread or signal handler."""
        self._stopping.set()
        self._cloud.abort_poll()

    def run(self):
        """Execute commands until ``stop``. Raises ``LegacyError``."""
        if "space" not in self._config:
            raise LegacyError("this robot is not paired; run `enroll` first")
        with contextlib.ExitStack() as stack:
            self._running = stack.enter_context(self._acquire())
            self._journal = Journal(os.path.join(self._home, "journal.jsonl"))
            stack.callback(self._journal.close)
            self._recover()
            self._run_threads()
        if self._error is not None:
            raise self._error

    def _run_threads(self):
        threads = [threading.Thread(target=self._guarded, args=(work,)) for work in (self._supervise, self._send_loop)]
        for thread in threads:
            thread.start()
        self._guarded(self._poll_loop)
        self._end("failed", "agent_stopping", "the wrapper was stopped")
        end_s = time.monotonic() + self._grace_s + 5.0
        while self._action is not None and time.monotonic() < end_s:
            time.sleep(0.02)
        self._finished.set()
        self._wake.set()
        for thread in threads:
            thread.join()

    def _guarded(self, work):
        """End the program if one thread fails: the others could not stop the robot."""
        try:
            work()
        except LegacyError as error:
            self._error = error
        except Exception as error:  # the message is shown instead of a traceback
            self._error = LegacyError(f"internal error: {error!r}")
            log.debug("internal error", exc_info=True)
        if self._error is not None:
            self.stop()

    def _acquire(self):
        """The lock of this folder, which scripts inherit."""
        file = open(os.path.join(self._home, "running.lock"), "a")  # noqa: SIM115 (kept open)
        end_s = time.monotonic() + 5
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                if time.monotonic() > end_s:
                    text = f"{self._home} is in use: the wrapper, or a script of an earlier run, still runs"
                    raise LegacyError(text) from None
                time.sleep(0.05)
            else:
                return file

    def _recover(self):
        """End what an earlier run did not finish. Its processes have ended: they held the lock."""
        values = self._journal.values
        self._latch = values.get("latch")
        self._burn()
        data = {"epoch": self._epoch, "stopped": self._latch is not None}
        self._event("agent-started", "the wrapper started", "info", data)
        message = "the wrapper restarted while this ran; it was stopped and not run again"
        for key, value in list(values.items()):
            ack = value["ack"] if key.startswith("command:") else {"status": "done"}
            if ack["status"] not in TERMINAL:
                self._sequences[ack["id"]] = ack["sequence"]
                self._ack(ack["id"], "failed", "agent_restarted", message)

    # ------------------------------------------------------------ receiving

    def _poll_loop(self):
        pause_s = 0.5
        while not self._stopping.is_set():
            try:
                self._connect()
                pause_s = 0.5
                while not self._stopping.is_set():
                    self._poll()
            except (OSError, CloudError) as error:
                if self._stopping.is_set():
                    return
                if getattr(error, "code", "") == "agent-unclaimed":
                    raise LegacyError("this robot was unpaired; run `enroll` again") from error
                if isinstance(error, CloudError) and error.code in ("protocol-unsupported", "invalid"):
                    raise LegacyError(f"the cloud rejects this robot: {error}") from error
                log.warning("%s: %s", "connection lost" if self._up else "no connection", error)
                self._up = False
                self._stopping.wait(pause_s * random.uniform(0.5, 1.0))  # noqa: S311 (not a secret)
                pause_s = min(2 * pause_s, 10.0)

    def _connect(self):
        config = self._config
        answer = self._cloud.call("GET", "/agents/enrollment", timeout_s=RESPONSE_S)
        if answer.get("state") != "claimed" or answer.get("space") != config["space"]:
            raise LegacyError("this robot was unpaired or moved to another space; run `enroll` again")
        try:
            self._follow(answer.get("key_statements", ()))
        except Refused as refused:  # Stop and reports are still useful
            log.warning("the cloud's new key is not trusted: %s", refused)
        if not self._announced:
            self._cloud.call("POST", "/agents/enroll", dict(introduction(config), capabilities=self._kinds()))
            self._announced = True
        with self._lock:
            session = self._journal.values.get("session", 0) + 1
            commands = {key: value for key, value in self._journal.values.items() if key.startswith("command:")}
            oldest_ms = (self._cloud.now_ms() or 0) - KEEP_MS
            forget = {key: None for key, value in commands.items() if value["sent"] and value["at_ms"] < oldest_ms}
            self._journal.put(dict(forget, session=session))
            unsent = [(self._topic("ack"), value["ack"]) for value in commands.values() if not value["sent"]]
            kept = [message for message in self._outbox if message[0].endswith("/event")]
            self._outbox = collections.deque(kept + unsent)
            self._have.clear()
        self._post([self._presence(session, online=True), (self._topic("desc"), self._description())])
        self._up = self._state_due = True
        self._wake.set()
        log.info("connected to %s", config["url"])

    def _poll(self):
        now_s = time.monotonic()
        with self._lock:
            self._have = {name: since_s for name, since_s in self._have.items() if now_s - since_s < 5.0}
            wait_s = BUSY_POLL_S if self._action is not None or self._have else LONG_POLL_S
            query = [("limit", 10), ("wait_ms", round(1000 * wait_s))]
            query += [("have", name) for name in list(self._have)[:32]]
        path = "/agents/{}/commands?{}".format(self._config["agent"], urllib.parse.urlencode(query))
        answer = self._cloud.call("GET", path, timeout_s=wait_s + RESPONSE_S)
        self._contact_s = time.monotonic()
        try:
            items = [(str(item["id"]), str(item["payload"])) for item in answer["items"]]
        except (KeyError, TypeError) as error:
            raise CloudError(f"the response lacks {error}", passing=True) from error
        for name, payload in items:
            with self._lock:
                self._have[name] = time.monotonic()
            self._receive(payload)
        if len(self._have) > 32:
            self._stopping.wait(0.2)  # `have` cannot name more: limit the repetitions

    def _receive(self, payload):
        """Verify, journal and execute one command."""
        command = None
        try:
            command = self._authenticate(payload)
            if self._is_duplicate(command):
                return
            self._check_time(command)
            try:
                self._apply(command)
            except (KeyError, TypeError) as error:
                raise Refused("malformed", f"a field of the request is not valid: {error}") from error
        except Refused as refused:
            log.warning("command rejected: %s", refused)
            data = {"code": refused.code}
            if command is not None:
                data.update(command=command["id"], caller=command["caller"], epoch=command["epoch"])
                status = "expired" if refused.code == "expired" else "failed"
                epoch = self._epoch if refused.code in ("stale_epoch", "lease_ended") else 0
                self._ack(command["id"], status, refused.code, str(refused), epoch=epoch)
            if time.monotonic() - self._rejected_s.get(refused.code, float("-inf")) > 5.0:
                self._rejected_s[refused.code] = time.monotonic()
                self._event("command-rejected", f"a command was rejected: {refused}", "warning", data)

    def _authenticate(self, payload):
        """The command in a signed message, with valid fields and this robot's address."""
        now_ms = self._cloud.now_ms()
        keys = {
            name: key["public"]
            for name, key in self._config["keys"].items()
            if not key["until_ms"] or now_ms is None or now_ms < key["until_ms"]
        }
        command = parse_envelope(payload, keys, b"telescope/v1/command\n")
        try:
            numbers = [command[name] for name in ("issued_at_ms", "ttl_ms", "epoch")]
            valid = ID.match(command["id"]) and isinstance(command["caller"], str)
            valid = valid and all(type(number) is int and number >= 0 for number in numbers)
            address = tuple(command[name] for name in ("space", "agent", "device"))
            kind = command["request"]["kind"]
        except (KeyError, TypeError) as error:
            raise Refused("malformed", f"the command lacks {error}") from error
        if not valid or not isinstance(kind, str):
            raise Refused("malformed", "a field of the command is not valid")
        if address != (self._config["space"], self._config["agent"], self._config["name"]):
            raise Refused("wrong_address", "the command is for another device")
        return command

    def _is_duplicate(self, command):
        """Journal a new command. For a known one, repeat its last ack; it must not run again."""
        with self._lock:
            known = self._journal.values.get("command:" + command["id"])
            # The cloud repeats a command that was rejected for its epoch, with a higher one.
            if known is not None and not 0 < known["ack"].get("reason", {}).get("epoch", 0) < command["epoch"]:
                self._outbox.append((self._topic("ack"), known["ack"]))
                self._wake.set()
                return True
            self._ack(command["id"], "received")
            return False

    def _check_time(self, command):
        now_ms = self._cloud.now_ms()
        if command["request"]["kind"] == "stop_device":
            return  # a late Stop still stops
        if now_ms is None:
            raise Refused("no_clock", "the robot does not know the cloud's time yet; retry")
        late_ms = now_ms - command["issued_at_ms"] - command["ttl_ms"]
        if late_ms > 0:
            raise Refused("expired", f"arrived {late_ms:.0f} ms after it had expired")
        if command["issued_at_ms"] > now_ms + 2000:
            raise Refused("from_the_future", "issued later than now; the cloud's clock is wrong")

    def _apply(self, command):
        request, name = command["request"], command["id"]
        kind = request["kind"]
        with self._lock:
            if kind == "stop_device":
                self._latch_stop(command)
                return
            if kind not in AUTHORITY:
                self._start(command)
                return
            if kind == "grant_lease":
                self._fence(command["epoch"])
                self._lease = command["epoch"], str(request["holder"]), time.monotonic() + request["lease_ms"] / 1000
            elif kind == "release_lease":
                self._fence(command["epoch"], ended=True)
                self._end("failed", "lease_lost", "control was released")
                self._burn()
            elif kind == "ask_lease":
                end_s = time.monotonic() + request["answer_within_ms"] / 1000
                self._request = request["request"], request["requester"], end_s
            elif kind == "drop_request":
                self._request = None
            elif kind == "reset_stop":
                self._fence(command["epoch"], ended=True)
                self._reset_stop(command)
            elif kind == "follow_key":
                self._follow(request["statements"])
            elif self._action is None or self._action.command["id"] != request["action"]:
                raise Refused("not_running", "this action does not run on the robot")
            else:
                self._action.end("cancelled", "cancelled", "cancelled by " + command["caller"])
            self._changed()
            self._ack(name, "done")

    # ------------------------------------------------------------ authority

    @property
    def _epoch(self):
        return self._journal.values.get("epoch", 0)

    @property
    def _burned(self):
        return self._journal.values.get("burned", 0)

    def _fence(self, epoch, ended=False):
        """Accept the newest or a newer epoch, which ends what the older one started. ``ended``: also an ended one."""
        if epoch < self._epoch:
            raise Refused("stale_epoch", f"from lease {epoch}, but lease {self._epoch} is in force")
        if epoch <= self._burned and not ended:
            raise Refused("lease_ended", f"lease {epoch} has ended at the robot; take control again")
        if epoch > self._epoch:
            self._end("failed", "lease_lost", "a newer lease took the robot")
            self._journal.put({"epoch": epoch})
            self._lease = self._request = None

    def _burn(self):
        """End the lease in force: the robot never accepts its epoch again."""
        self._lease = self._request = None
        if self._burned < self._epoch:
            self._journal.put({"burned": self._epoch})
        self._changed()

    def _latch_stop(self, command):
        """Latch Stop. It is acknowledged by ``_supervise`` when no action runs any more."""
        self._end("failed", "stopped", "stopped by " + command["caller"])
        self._stops.append(command["id"])
        if self._latch is None:
            reason = str(command["request"].get("reason", ""))[:MAX_TEXT]
            self._latch = {"caller": command["caller"], "reason": reason, "at_ms": wall_ms(), "verified": True}
            self._journal.put({"latch": self._latch})
            self._event("stop-latched", "stopped by " + command["caller"], "warning", self._latch)
        self._burn()

    def _reset_stop(self, command):
        for name in self._stops:
            self._ack(name, "failed", "reset", "Stop was reset before the robot had stopped")
        self._stops = []
        if self._latch is not None:
            self._journal.put({"latch": None})
            self._event("stop-reset", "Stop was reset by " + command["caller"], "info", {"caller": command["caller"]})
        self._latch = None
        self._burn()

    def _follow(self, statements):
        """Pin the keys that these statements introduce, each signed with a pinned key."""
        for statement in statements:
            config, now_ms = self._config, self._cloud.now_ms()
            keys = {name: key["public"] for name, key in config["keys"].items() if not key["until_ms"]}
            try:
                new = json.loads(statement)["body"]
                if new["serial"] <= config["serial"]:
                    continue  # it is pinned already, or older than the pinned key
                new = parse_envelope(statement, keys, b"telescope/v1/keys\n")
                text, end_ms = new["key"], new["former_until_ms"]
                if len(from_text(text)) != 32 or type(new["serial"]) is not int or type(end_ms) is not int:
                    raise ValueError("not a key")
            except (ValueError, KeyError, TypeError, RecursionError) as error:
                raise Refused("malformed", "the statement of a new key is not valid") from error
            if now_ms is None or now_ms >= end_ms:
                raise Refused("expired", "the key that signed the statement has expired; run `enroll` again")
            old = {
                name: dict(key, until_ms=min(key["until_ms"] or end_ms, end_ms))
                for name, key in config["keys"].items()
                if not key["until_ms"] or key["until_ms"] > now_ms
            }
            old[key_id(text)] = {"public": text, "until_ms": 0}
            changed = dict(config, keys=old, serial=new["serial"])
            save_config(self._home, changed)
            self._config = changed

    # ------------------------------------------------------------ executing

    def _start(self, command):
        request = command["request"]
        kind = request["kind"]
        name = request["name"] if kind == "run_behaviour" else kind
        function = self._functions.get(name)
        if function is None or (kind == "run_behaviour") == (name in WITH_PARAMETERS):
            raise Refused("cannot", "the robot has no {}; it has: {}".format(name, ", ".join(sorted(self._functions))))
        if self._action is not None:
            raise Refused("busy", "action {} runs on the robot".format(self._action.command["id"]))
        self._fence(command["epoch"])
        if self._latch is not None:
            raise Refused("stopped", "stopped by {}; reset Stop first".format(self._latch["caller"]))
        parameters = {key: value for key, value in request.items() if key not in ("kind", "name")}
        self._ack(command["id"], "accepted")
        self._action = action = Action(command, name, parameters)
        self._contact_s = time.monotonic()
        self._changed()
        threading.Thread(target=self._execute, args=(action, function), daemon=True).start()

    def _execute(self, action, function):
        result, failure = {}, None
        try:
            self._ack(action.command["id"], "started")
            if not action.ended.is_set():
                result = dict(function(action) or {})
                if len(json.dumps(result, allow_nan=False)) > MAX_RESULT:
                    raise ValueError("the result is too large")
        except BaseException as error:  # noqa: BLE001 (any error of the function ends the action as failed)
            failure = "failed", "script_failed", str(error) or type(error).__name__
        with self._lock:
            status, code, message = action.why or failure or ("done", "", "")
            result = {} if failure else dict(result, duration_s=round(time.monotonic() - action.started_s, 3))
            self._action = None
            self._changed()
            try:
                self._ack(action.command["id"], status, code, message, output=action.output, result=result)
            except LegacyError as error:
                self._error = error
                self.stop()

    def _end(self, status, code, message):
        """Ask the running action to end; its lease ends too."""
        with self._lock:
            if self._action is not None and self._action.why is None:
                self._action.end(status, code, message)
                self._event("action-lost", message, "warning", {"code": code, "epoch": self._epoch})

    def _supervise(self):
        """Transitions due to timeouts, and the confirmation of Stop."""
        while not self._finished.wait(0.05):
            if self._stopping.is_set():
                self._cloud.abort_poll()  # it may have started after ``stop``
            with self._lock:
                now_s = time.monotonic()
                if self._lease is not None and now_s >= self._lease[2]:
                    self._end("failed", "lease_lost", "the lease expired")
                    self._burn()
                if self._request is not None and now_s >= self._request[2]:
                    self._request = None
                    self._changed()
                if self._action is not None:
                    self._check_action(self._action, now_s)
                    continue
                stops, self._stops = self._stops, []
                for name in stops:
                    self._ack(name, "done")

    def _check_action(self, action, now_s):
        """End the running action after a time limit, and report its output once per second."""
        if action.why is None and now_s - self._contact_s > self._lost_after_s:
            self._end("failed", "link_lost", "the connection to the cloud was lost while this ran")
            self._burn()
        if action.why is None and now_s - action.started_s > self._max_s:
            action.end("failed", "too_long", f"ended after the time limit of {self._max_s:g} s")
        if action.why is not None and not action.late and now_s - action.ended_s > 5.0:
            action.late = True
            self._changed()
        if action.output != action.reported and now_s - action.reported_s > 1.0:
            action.reported, action.reported_s = action.output, now_s
            self._ack(action.command["id"], "started", output=action.output)

    # ------------------------------------------------------------ sending

    def _ack(self, name, status, code="", message="", *, output="", result=None, epoch=0):
        """Journal the next ack of a command, and send it; the first one only if it is repeated."""
        ack = {"id": name, "status": status, "at_ms": wall_ms(), "tick_ms": int(time.monotonic() * 1000)}
        ack.update(output=output, result=result or {})
        if code:
            ack["reason"] = {"code": code, "message": message[:MAX_TEXT], "epoch": epoch}
        with self._lock:
            ack["sequence"] = self._sequences[name] = self._sequences.get(name, 0) + 1
            if status in TERMINAL:
                del self._sequences[name]
            at_ms = self._cloud.now_ms() or wall_ms()
            try:
                self._journal.put({"command:" + name: {"ack": ack, "sent": False, "at_ms": at_ms}})
            finally:  # the end of an action is also reported with a full disk
                if status != "received":
                    self._outbox.append((self._topic("ack"), ack))
                    self._wake.set()

    def _event(self, kind, message, severity, data):
        event = {"id": to_text(os.urandom(12)), "device": self._config["name"], "at_ms": wall_ms(), "kind": kind}
        event.update(severity=severity, message=message[:MAX_TEXT], data=data)
        with self._lock:
            if len(self._outbox) < 1000:
                self._outbox.append((self._topic("event"), event))
        self._wake.set()

    def _changed(self):
        self._state_due = True
        self._wake.set()

    def _send_loop(self):
        while True:
            self._wake.wait(0.2 if self._state_due or self._outbox else 5.0)
            self._wake.clear()
            last = self._finished.is_set()
            try:
                if self._up:
                    self._send(last)
                    self._report_times()
            except (OSError, CloudError) as error:
                log.warning("not sent: %s", error)
                self._finished.wait(0.5)
            if last:
                return

    def _send(self, last):
        with self._lock:
            batch = [self._outbox[index] for index in range(min(50, len(self._outbox)))]
            now_s = time.monotonic()
            with_state = last or now_s - self._state_s > (1.0 if self._state_due else 30.0)
            messages = list(batch)
            if with_state:
                self._state_due, self._state_s = False, now_s
                messages.append((self._topic("state"), self._state()))
            if last:
                messages.append(self._presence(self._journal.values["session"], online=False))
        if not messages:
            return
        try:
            self._post(messages)
        except (OSError, CloudError):
            self._state_due = self._state_due or with_state
            raise
        if with_state:
            duration_ms = round((time.monotonic() - now_s) * 1000, 3)
            self._samples.append({"at_ms": int(self._cloud.now_ms() or wall_ms()), "ms": duration_ms})
        with self._lock:
            for message in batch:
                self._remove_sent(message)
            if self._outbox:
                self._wake.set()

    def _remove_sent(self, message):
        if self._outbox and self._outbox[0][1] is message[1]:  # else the connection was renewed meanwhile
            self._outbox.popleft()
        name = message[1]["id"]
        known = self._journal.values.get("command:" + name)
        if known is not None:
            self._have.pop(name, None)
            if known["ack"] == message[1] and not known["sent"]:
                self._journal.put({"command:" + name: dict(known, sent=True)})

    def _post(self, messages):
        """Send messages. Those that the cloud rejects are logged and not repeated."""
        body = {"messages": [{"topic": topic, "payload": payload} for topic, payload in messages]}
        path = "/agents/{}/messages".format(self._config["agent"])
        answer = self._cloud.call("POST", path, body, timeout_s=RESPONSE_S)
        self._contact_s = time.monotonic()
        for (topic, _), result in zip(messages, answer.get("results", ())):
            if result.get("status") != "stored":
                log.warning("the cloud rejected a message on %s: %s", topic, result.get("detail"))

    def _report_times(self):
        """Store the response times of the cloud, as measured here, in the cloud."""
        if not self._samples or time.monotonic() - self._reported_s < self._report_s:
            return
        self._reported_s = time.monotonic()
        samples = [self._samples.popleft() for _ in range(len(self._samples))]
        report = {"device": self._config["name"], "transport": "http", "path": "device-cloud", "samples": samples}
        self._cloud.call("POST", "/agents/{}/latency".format(self._config["agent"]), report, timeout_s=RESPONSE_S)

    def _topic(self, kind):
        return "ts/v1/{space}/{agent}/{name}/".format(**self._config) + kind

    def _presence(self, session, online):
        topic = "ts/v1/{space}/{agent}/conn".format(**self._config)
        presence = {"online": online, "session": session, "at_ms": wall_ms(), "software": SOFTWARE}
        return topic, dict(presence, capabilities=self._kinds())

    def _kinds(self):
        own = [name for name in self._functions if name in WITH_PARAMETERS]
        return sorted(AUTHORITY + tuple(own) + (("run_behaviour",) if len(own) < len(self._functions) else ()))

    def _description(self):
        return {
            "device": self._config["name"],
            "kind": "robot",
            "robot_type": self._config["type"],
            "label": self._config["label"],
            "actions": [kind for kind in self._kinds() if kind not in AUTHORITY],
            "behaviours": sorted(name for name in self._functions if name not in WITH_PARAMETERS),
            "streaming": False,
            "scripts_note": "The wrapper for legacy robots runs only what is installed on the robot.",
        }

    def _state(self):
        action, now_s = self._action, time.monotonic()
        state = {"device": self._config["name"], "at_ms": wall_ms(), "tick_ms": int(now_s * 1000), "mode": "idle"}
        state.update(epoch=self._epoch, ended_epoch=self._burned, stop=self._latch)
        if self._latch is not None:
            state["mode"] = "stopped"
        if action is not None:
            kind = action.command["request"]["kind"]
            state.update(mode="action", action={"id": action.command["id"], "kind": kind, "name": action.name})
            if action.late:
                message = "the action was ended, but its function has not returned"
                fault = {
                    "code": "not_stopping",
                    "message": message,
                    "since_ms": wall_ms() - int((now_s - action.ended_s) * 1000),
                }
                state["faults"] = [fault]
        if self._lease is not None:
            epoch, holder, end_s = self._lease
            state["lease"] = {"epoch": epoch, "holder": holder, "expires_in_ms": _left_ms(end_s)}
            if self._request is not None:
                name, requester, end_s = self._request
                state["lease"]["request"] = {"id": name, "requester": requester, "expires_in_ms": _left_ms(end_s)}
        return state


def _left_ms(end_s):
    return max(0, int((end_s - time.monotonic()) * 1000))


# ---------------------------------------------------------------- pairing and command line


def wall_ms():
    """The robot's wall clock [ms since 1970], for display."""
    return int(time.time() * 1000)


def load_config(home):
    """Key and pairing of a home folder. Raises ``LegacyError``."""
    path = os.path.join(home, "agent.json")
    try:
        os.chmod(path, 0o600)
        with open(path, encoding="utf-8") as file:
            config = json.load(file)
        return {key: config[key] for key in ("url", "seed", "ca", "name", "type", "label")} and config
    except FileNotFoundError:
        raise LegacyError(f"{home} holds no robot; run `enroll` first") from None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise LegacyError(f"{path} cannot be read: {error}") from error


def save_config(home, config):
    """Store key and pairing."""
    write_private(os.path.join(home, "agent.json"), json.dumps(config, indent=1) + "\n")


def introduction(config):
    """The robot as the cloud enrols it."""
    device = {"name": config["name"], "kind": "robot", "robot_type": config["type"], "label": config["label"]}
    return {
        "name": config["name"],
        "public_key": to_text(public_key(bytes.fromhex(config["seed"]))),
        "software": SOFTWARE,
        "transport": "http",
        "devices": [device],
    }


def enroll(url, name, *, robot_type="", label="", ca=None, home=HOME):
    """Create a key, print claim codes until an account redeems one, and pin the keys of the cloud."""
    for text in (name, robot_type or name):
        if not ID.match(text):
            raise LegacyError(f"'{text}' is not a name: use letters, digits, _ and -")
    if os.path.exists(os.path.join(home, "agent.json")):
        config = load_config(home)
        if (config["url"], config["name"]) != (url, name):
            raise LegacyError("{} holds the robot {name} of {url}; use another --home".format(home, **config))
    else:
        os.makedirs(home, mode=0o700, exist_ok=True)
        config = {"url": url, "name": name, "type": robot_type or name, "label": label or name}
        config.update(ca=None if ca is None else os.path.abspath(ca), seed=os.urandom(32).hex())
        save_config(home, config)
    cloud = Cloud(url, bytes.fromhex(config["seed"]), config["ca"])
    try:
        while True:
            code = cloud.call("POST", "/agents/enroll", introduction(config))["claim_code"]
            if code is not None:
                print(f"claim code: {code}  (valid for five minutes: Pair a device in the console)", flush=True)
            end_s = time.monotonic() + 270
            while time.monotonic() < end_s:
                answer = cloud.call("GET", "/agents/enrollment?wait_ms=20000", timeout_s=30.0)
                if answer["state"] == "claimed":
                    keys = {key["id"]: {"public": key["public"], "until_ms": key["until_ms"]} for key in answer["keys"]}
                    config.update(agent=answer["agent"], space=answer["space"], keys=keys)
                    save_config(home, dict(config, serial=max(key["serial"] for key in answer["keys"])))
                    print(f"paired with the account {answer['account']['name']}", flush=True)
                    return
    except (OSError, CloudError) as error:
        raise LegacyError(f"the enrolment failed: {error}") from error


def main(arguments=None):
    """The command line; returns the exit code."""
    parser = argparse.ArgumentParser(description="Connects a robot with an old Python to Telescope.")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    pair = commands.add_parser("enroll", help="register the robot, print a claim code and wait until it is redeemed")
    pair.add_argument("--url", required=True, help="address of the server")
    pair.add_argument("--name", required=True, help="name of the robot: letters, digits, _ and -")
    pair.add_argument("--type", default="", help="robot type; default: the name")
    pair.add_argument("--label", default="", help="display name; default: the name")
    pair.add_argument("--ca", help="file with the certificate authority of the server")
    start = commands.add_parser("run", help="execute commands until the end of the program")
    start.add_argument("--movements", required=True, help="folder with scripts: NAME.py or executable files")
    start.add_argument("--lost-after", type=float, default=5.0, metavar="S", help="stop without a response for [s]; 5")
    start.add_argument("--max-duration", type=float, default=600.0, metavar="S", help="limit of each action [s]; 600")
    start.add_argument("--grace", type=float, default=0.5, metavar="S", help="from SIGTERM to SIGKILL [s]; 0.5")
    start.add_argument("--report-every", type=float, default=60.0, metavar="S", help="report response times [s]; 60")
    for each in (pair, start):
        each.add_argument("--home", default=HOME, help="folder of key and journal; ~/.telescope-legacy")
    choice = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    try:
        if choice.command == "enroll":
            enroll(choice.url, choice.name, robot_type=choice.type, label=choice.label, ca=choice.ca, home=choice.home)
        elif choice.command == "run":
            robot = Robot(
                choice.home,
                lost_after_s=choice.lost_after,
                max_s=choice.max_duration,
                grace_s=choice.grace,
                report_s=choice.report_every,
            )
            robot.on_files(choice.movements)
            signal.signal(signal.SIGTERM, lambda *_: robot.stop())
            signal.signal(signal.SIGINT, lambda *_: robot.stop())
            robot.run()
        else:
            parser.print_help()
            return 2
    except (LegacyError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(guard(sys.argv[2], sys.argv[3], sys.argv[4:]) if sys.argv[1:2] == ["guard"] else main())
