"""Reads lines from a serial port in a thread, and converts them to samples."""

import logging
import threading

import serial

from device_agent.ports.sensor import SensorError, Values
from device_agent.ports.threads import Recovery, SupervisedThread
from device_agent.protocol.manifests.room import RoomDeviceManifest
from device_agent.sensors.configured_device import ConfiguredDevice, SampleInbox
from device_agent.sensors.conversion import ConversionError
from device_agent.sensors.serial.line_reader import LineError, LineReader, parser
from device_agent.sensors.serial.options import Options

LINES = "lines"
"""Optional stream: how many lines were received, malformed and too long since the agent has started."""
_READ_S = 0.2
_RESPONSE_S = 10.0
_END_S = 5.0
_MAX_CHUNK = 4096
_MALFORMED = 10
"""Number of consecutive malformed lines that is a fault."""
_log = logging.getLogger(__name__)


class SerialSensor(ConfiguredDevice):
    """See ``RoomDriver``. Each line is returned once."""

    def __init__(self, device: RoomDeviceManifest, options: Options) -> None:
        counted = any(stream.name == LINES for stream in device.streams) and LINES not in options.streams
        streams = {name: list(sources) for name, sources in options.streams.items()}
        if counted:
            streams[LINES] = ["received", "malformed", "overlong"]
        super().__init__(device, streams=streams, controls=())
        self._options = options
        self._counted = counted
        self._parse = parser(options)
        self._life = threading.Lock()
        self._stopping = threading.Event()
        self._port: serial.Serial | None = None
        self._thread: SupervisedThread | None = None
        self._inbox = SampleInbox()
        self._lost = ""
        self._received = self._malformed = self._overlong = self._consecutive = 0
        self._newest_error = ""

    # ------------------------------------------------------------ RoomDriver

    def connect(self) -> None:
        """See ``RoomDriver``."""
        with self._life:
            if self._lost:
                self._disconnect()
            if self._port is None:
                self._open()
        self._check()
        self._inbox.check()

    def read(self, stream: str) -> Values:
        """See ``RoomDriver``."""
        if self._port is None:
            raise self.not_connected()
        self._check()
        if stream in self._options.streams:
            return self._inbox.take(stream)
        if stream == LINES and self._counted:
            return {
                "received": float(self._received),
                "malformed": float(self._malformed),
                "overlong": float(self._overlong),
            }
        return self.reject_unknown("stream", stream, [known.name for known in self.device.streams])

    def set(self, control: str, value: float) -> float:  # noqa: ARG002 (it has none)
        """See ``RoomDriver``."""
        return self.reject_unknown("control", control, ())

    def close(self) -> None:
        """See ``RoomDriver``."""
        with self._life:
            self._disconnect()

    # ------------------------------------------------------------ internal

    def _open(self) -> None:
        options = self._options
        try:
            port = serial.Serial(
                options.path,
                options.baud,
                bytesize=options.data_bits,
                parity=options.parity[0].upper(),
                stopbits=options.stop_bits,
                timeout=_READ_S,
                exclusive=True,
            )
        except (serial.SerialException, OSError, ValueError) as error:
            raise SensorError(
                f"{options.path} of '{self.device.name}' cannot be opened; check that the sensor is plugged in, that "
                "this user may open the port, and that no other program uses it"
            ) from error
        self._port, self._lost = port, ""
        self._consecutive, self._newest_error = 0, ""
        self._inbox.clear()
        self._stopping = stopping = threading.Event()
        self._thread = thread = SupervisedThread(
            lambda: self._run(port, thread, stopping),
            name=f"{self.device.name}-serial",
            part="reader of the serial port",
            device=self.device.name,
            stopping=stopping,
            recovery=Recovery.RESTART,
            within_s=_RESPONSE_S,
        )
        thread.start()

    def _disconnect(self) -> None:
        self._stopping.set()
        if self._thread is not None:
            self._thread.join(_END_S)
            self._thread = None
        if self._port is not None:
            self._port.close()
            self._port = None

    def _check(self) -> None:
        if self._lost:
            raise SensorError(self._lost)
        if self._consecutive >= _MALFORMED:
            raise SensorError(
                f"the last {_MALFORMED} lines of '{self.device.name}' were not usable: {self._newest_error}; check "
                "`baud`, `format` and `pattern`"
            )

    def _run(self, port: serial.Serial, thread: SupervisedThread, stopping: threading.Event) -> None:
        lines = LineReader(self._options.max_line)
        while not stopping.is_set():
            thread.beat()
            try:
                data = port.read(min(max(1, port.in_waiting), _MAX_CHUNK))
            except (serial.SerialException, OSError):
                self._lost = (
                    f"{self._options.path} of '{self.device.name}' does not respond; check that it is plugged in"
                )
                _log.warning("%s", self._lost)
                stopping.wait()  # `connect` replaces this thread
                return
            for line in lines.add(data):
                self._accept(line)

    def _accept(self, line: bytes | None) -> None:
        """Process a line, or ``None`` for one that was too long."""
        self._received += 1
        if line is None:
            self._overlong += 1
            self._reject(f"longer than `max_line`, {self._options.max_line} bytes")
            return
        try:
            fields = self._parse(line)
        except LineError as error:
            self._malformed += 1
            self._reject(str(error))
            return
        self._consecutive = 0
        for stream, sources in self._options.streams.items():
            values: dict[str, float | bool] = {}
            quantity = ""
            try:
                for quantity, source in sources.items():
                    values[quantity] = source.value(fields(source.field))
            except (LineError, ConversionError) as error:
                self._inbox.fail(stream, f"stream '{stream}' of '{self.device.name}': {quantity} is {error}")
            else:
                self._inbox.put(stream, values)

    def _reject(self, problem: str) -> None:
        self._consecutive += 1
        self._newest_error = problem
