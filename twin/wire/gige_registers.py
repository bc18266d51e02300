"""The registers of an emulated GigE Vision camera: its bootstrap registers, its own, and its GenICam description.

All are big-endian. Addresses of the bootstrap registers are those of the GigE Vision standard; ``gige_features.xml``
tells a client where the camera's own are and what they mean.
"""

import math
import struct
from dataclasses import dataclass
from importlib import resources
from string import Template
from xml.sax.saxutils import escape

VENDOR, MODEL, FIRMWARE, SERIAL = (0x48, 32), (0x68, 32), (0x88, 32), (0xD8, 16)  # address and length
XML_URL = 0x200
HEARTBEAT_MS = 0x938
TIMESTAMP_CONTROL, TIMESTAMP_VALUE = 0x944, 0x948
CONTROL_PRIVILEGE = 0xA00
STREAM_PORT, PACKET_SIZE, PACKET_DELAY, STREAM_ADDRESS, STREAM_SOURCE_PORT = 0xD00, 0xD04, 0xD08, 0xD18, 0xD1C
WIDTH, HEIGHT, OFFSET_X, OFFSET_Y, PIXEL_FORMAT = 0x4000, 0x4004, 0x4008, 0x400C, 0x4010
ACQUISITION, TRIGGER_MODE, TRIGGER_SOFTWARE = 0x4014, 0x4018, 0x401C
EXPOSURE_US, GAIN_DB = 0x4020, 0x4028  # float64

DISCOVERY_BYTES = 0xF8
FIRE_TEST_PACKET = 1 << 31
PACKET_MIN, PACKET_MAX, PACKET_DEFAULT = 576, 16_384, 8192  # bytes with the headers of IP and UDP
LEAST_PIXELS = 4  # along a side of a region

PIXEL_CODES = {"Mono8": 0x0108_0001, "Mono12": 0x0110_0005, "Mono16": 0x0110_0007}

INVALID_PARAMETER, INVALID_ADDRESS, WRITE_PROTECT = 0x8002, 0x8003, 0x8004
BAD_ALIGNMENT, ACCESS_DENIED, BUSY = 0x8005, 0x8006, 0x8007

_XML = 0x8000
_READABLE = ((0x0, 0xE00), (0x4000, 0x4030))  # beside the description
_TICKS_PER_S = 1_000_000_000
_VERSION = 0x0001_0002  # GigE Vision 1.2
_BIG_ENDIAN_UTF8 = 0x8000_0001
_STATIC_ADDRESS = 1 << 0
_CAN_CONCATENATE, _CAN_WRITE_MEMORY, _CAN_RESEND, _HAS_SERIAL = 1 << 0, 1 << 1, 1 << 2, 1 << 30


class Refused(Exception):
    """A request that a camera answers with ``status``, a code of the standard."""

    def __init__(self, status: int):
        super().__init__(hex(status))
        self.status = status


@dataclass(frozen=True)
class CameraModel:
    """What a camera is: its name plate, its sensor and what it can be set to."""

    vendor: str
    model: str
    serial: str
    firmware: str
    shape: tuple[int, int]  # (rows, cols)
    exposure_limits_us: tuple[float, float]
    gain_limits_db: tuple[float, float] = (0.0, 0.0)
    pixel_format: str = "Mono8"

    @property
    def pixel_bytes(self) -> int:
        """Of one pixel on the wire."""
        return 1 if self.pixel_format == "Mono8" else 2


class Registers:
    """The camera's memory. Writes are checked against what the camera can do; reads of nothing are refused.

    Parameters
    ----------
    model : CameraModel
    address : bytes
        The camera's IPv4 address.
    """

    def __init__(self, model: CameraModel, address: bytes):
        self._model = model
        xml = _description(model)
        self._end = _XML + len(xml)
        self._memory = bytearray(self._end)
        self._memory[_XML:] = xml
        for (start, length), text in (
            (VENDOR, model.vendor),
            (MODEL, model.model),
            (FIRMWARE, model.firmware),
            (SERIAL, model.serial),
            ((XML_URL, 512), f"Local:greenough.xml;{_XML:x};{len(xml):x}"),
        ):
            data = text.encode()[: length - 1]
            self._memory[start : start + len(data)] = data
        rows, cols = model.shape
        for start, value in {
            0x0: _VERSION,
            0x4: _BIG_ENDIAN_UTF8,
            0x8: 0x0200,  # a MAC address that is locally administered, with the IPv4 address as its end
            0xC: int.from_bytes(address),
            0x10: _STATIC_ADDRESS,
            0x14: _STATIC_ADDRESS,
            0x24: int.from_bytes(address),
            0x34: 0xFF00_0000,
            0x600: 1,  # network interfaces
            0x904: 1,  # stream channels
            0x934: _CAN_CONCATENATE | _CAN_WRITE_MEMORY | _CAN_RESEND | _HAS_SERIAL,
            HEARTBEAT_MS: 15_000,
            0x940: _TICKS_PER_S,
            PACKET_SIZE: PACKET_DEFAULT,
            WIDTH: cols,
            HEIGHT: rows,
            PIXEL_FORMAT: PIXEL_CODES[model.pixel_format],
        }.items():
            self.set_u32(start, value)
        struct.pack_into(">d", self._memory, EXPOSURE_US, model.exposure_limits_us[0])
        struct.pack_into(">d", self._memory, GAIN_DB, model.gain_limits_db[0])

    def u32(self, address: int) -> int:
        return struct.unpack_from(">I", self._memory, address)[0]

    def set_u32(self, address: int, value: int) -> None:
        struct.pack_into(">I", self._memory, address, value)

    def set_u64(self, address: int, value: int) -> None:
        struct.pack_into(">Q", self._memory, address, value)

    def f64(self, address: int) -> float:
        return struct.unpack_from(">d", self._memory, address)[0]

    def read(self, address: int, length: int) -> bytes:
        """Raises Refused where nothing is, or where ``address`` or ``length`` is no multiple of four."""
        if address % 4 or length % 4:
            raise Refused(BAD_ALIGNMENT)
        if not any(start <= address <= address + length <= end for start, end in (*_READABLE, (_XML, self._end))):
            raise Refused(INVALID_ADDRESS)
        return bytes(self._memory[address : address + length])

    def write(self, address: int, data: bytes, streaming: bool, client: bytes) -> None:
        """Write one register.

        Parameters
        ----------
        address : int
        data : bytes
            The whole register: 4 bytes, or 8 of a float64.
        streaming : bool
            Whether frames are being acquired: their size is fixed then.
        client : bytes
            IPv4 address of who writes: the only one that frames are ever sent to.

        Raises
        ------
        Refused
            When the register does not exist, cannot be written or cannot take the value.
        """
        if address % 4:
            raise Refused(BAD_ALIGNMENT)
        if address in (EXPOSURE_US, GAIN_DB):
            limits = self._model.exposure_limits_us if address == EXPOSURE_US else self._model.gain_limits_db
            if len(data) != 8 or not limits[0] <= struct.unpack(">d", data)[0] <= limits[1]:
                raise Refused(INVALID_PARAMETER)
        else:
            if len(data) != 4:
                raise Refused(INVALID_PARAMETER)
            self._check_u32(address, int.from_bytes(data), streaming, client)
        self._memory[address : address + len(data)] = data

    def _check_u32(self, address: int, value: int, streaming: bool, client: bytes) -> None:
        rows, cols = self._model.shape
        valid = {
            HEARTBEAT_MS: 500 <= value <= 60_000,
            TIMESTAMP_CONTROL: True,
            CONTROL_PRIVILEGE: value <= 3,
            STREAM_PORT: value <= 0xFFFF,
            PACKET_SIZE: PACKET_MIN <= value & 0xFFFF <= PACKET_MAX,
            PACKET_DELAY: True,  # the camera paces itself, whatever is asked for
            STREAM_ADDRESS: value in (0, int.from_bytes(client)),
            WIDTH: LEAST_PIXELS <= value <= cols - self.u32(OFFSET_X),
            HEIGHT: LEAST_PIXELS <= value <= rows - self.u32(OFFSET_Y),
            OFFSET_X: value <= cols - self.u32(WIDTH),
            OFFSET_Y: value <= rows - self.u32(HEIGHT),
            PIXEL_FORMAT: value == PIXEL_CODES[self._model.pixel_format],
            ACQUISITION: value <= 1,
            TRIGGER_MODE: value <= 1,
            TRIGGER_SOFTWARE: value == 1,
        }.get(address)
        if valid is None:
            raise Refused(WRITE_PROTECT if self._exists(address) else INVALID_ADDRESS)
        if not valid:
            raise Refused(INVALID_PARAMETER)
        if streaming and WIDTH <= address <= PIXEL_FORMAT:
            raise Refused(BUSY)

    def _exists(self, address: int) -> bool:
        return any(start <= address < end for start, end in (*_READABLE, (_XML, self._end)))


def _description(model: CameraModel) -> bytes:
    """The camera's GenICam description, padded to whole registers."""
    template = Template((resources.files("greenough.twin.wire") / "gige_features.xml").read_text())
    (low_us, high_us), (low_db, high_db) = model.exposure_limits_us, model.gain_limits_db
    if not all(math.isfinite(limit) for limit in (low_us, high_us, low_db, high_db)):
        raise ValueError("a camera's limits are finite")
    text = template.substitute(
        vendor=escape(model.vendor, {'"': "&quot;"}),
        model=escape(model.model, {'"': "&quot;"}),
        rows=model.shape[0],
        cols=model.shape[1],
        exposure_min_us=low_us,
        exposure_max_us=high_us,
        gain_min_db=low_db,
        gain_max_db=high_db,
        pixel_format=model.pixel_format,
        pixel_code=PIXEL_CODES[model.pixel_format],
        pixel_bytes=model.pixel_bytes,
        packet_min=PACKET_MIN,
        packet_max=PACKET_MAX,
    ).encode()
    return text + b" " * (-len(text) % 4)
