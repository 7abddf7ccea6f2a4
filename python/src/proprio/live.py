"""The newest state of a robot, from shared memory: values, or the reason why there is none."""

import dataclasses
import math
import os
import threading
from dataclasses import dataclass
from typing import (
    Any,
    Callable,
    Dict,
    List,
    Literal,
    Optional,
    Sequence,
    Tuple,
    Type,
    TypeVar,
    Union,
    cast,
    final,
)

import numpy as np
import numpy.typing as npt

from ._library import ffi, lib

Floats = npt.NDArray[np.float64]

JOINT: int = lib.PROPRIO_KIND_JOINT
"""The kind of a channel: a joint's encoder."""
WRENCH: int = lib.PROPRIO_KIND_WRENCH
"""The kind of a channel: a force/torque sensor."""
IMU: int = lib.PROPRIO_KIND_IMU
"""The kind of a channel: an inertial measurement unit."""


def now() -> float:
    """CLOCK_MONOTONIC [s], the clock of the robot's stamps."""
    return float(lib.proprio_now()) * 1e-9


@final
@dataclass(frozen=True)
class Unavailable:
    """Why there is no value. It is false: ``if torque := robot.torque("l_elbow"): ...``"""

    status: str
    """``never_seen``, ``stale``, ``not_described``, ``unknown`` or ``withheld``"""
    reason: Optional[str]
    """why it is withheld, in one word, as ``saturated``"""
    channel: Optional[str]
    """the channel that is the cause, if there is a single one"""
    age: float
    """how old the last value is [s]; 0 if there is none"""
    text: str
    """all of this for a person"""

    def __bool__(self) -> Literal[False]:
        return False

    def __str__(self) -> str:
        return self.text


@final
@dataclass(frozen=True)
class Torque:
    """The torque of a joint, by the parent link on the child link along the URDF axis."""

    torque: float
    """[Nm] (force [N] for a prismatic joint)"""
    standard_deviation: float
    """[Nm]; NaN where it is not known"""
    acquired: float
    """when it was measured [s], in the clock of ``now``"""
    age: float
    """how old it was at the last update [s]"""


@final
@dataclass(frozen=True, eq=False)
class Torques:
    """The torques of joints, in one order."""

    names: Tuple[str, ...]
    torque: Floats
    """[Nm]; NaN where there is none"""
    standard_deviation: Floats
    """[Nm]"""
    status: npt.NDArray[np.int32]
    """0 where there is a value; ``STATUS`` has the words, ``RobotReader.torque`` the reason"""
    acquired: float
    """the instant that all refer to [s], in the clock of ``now``; NaN if none has a value"""

    @property
    def available(self) -> npt.NDArray[np.bool_]:
        """Where there is a value."""
        available: npt.NDArray[np.bool_] = self.status == 0
        return available


@final
@dataclass(frozen=True, eq=False)
class Contact:
    """The wrench of a contact, by the environment on the link, in the contact's frame."""

    force: Floats
    """[N]"""
    torque: Floats
    """[Nm], about the frame's origin"""
    standard_deviation: Floats
    """of force [N] and torque [Nm]: six numbers"""
    position: Floats
    """where it is taken to act [m]"""
    is_detected: bool
    """it was not declared: F/T readings show it"""
    is_located: bool
    """a declaration or a skin says where it is"""
    acquired: float
    """when it was measured [s], in the clock of ``now``"""
    age: float
    """how old it was at the last update [s]"""


@final
@dataclass(frozen=True)
class JointState:
    """What a joint's device reports; NaN where it does not."""

    position: float
    """[rad, or m]"""
    velocity: float
    """[rad/s]"""
    acceleration: float
    """[rad/s^2]"""
    torque: float
    """[Nm]"""
    current: float
    """[A]"""
    acquired: float
    """when it was measured [s], in the clock of ``now``"""
    age: float
    """how old it was at the last update [s]"""
    quality: int
    """bits ``PROPRIO_QUALITY_...`` of proprio.h; none of them makes it unusable"""


@final
@dataclass(frozen=True, eq=False)
class Wrench:
    """What a force/torque sensor reports, in its own axes about its own origin."""

    force: Floats
    """[N]"""
    torque: Floats
    """[Nm]; NaN if the sensor measures none"""
    acquired: float
    """when it was measured [s], in the clock of ``now``"""
    age: float
    """how old it was at the last update [s]"""
    quality: int
    """as of ``JointState``"""


@final
@dataclass(frozen=True, eq=False)
class Imu:
    """What an inertial measurement unit reports, in its own axes; NaN where it does not."""

    proper_acceleration: Floats
    """acceleration minus gravity [m/s^2]: it points up at rest"""
    angular_velocity: Floats
    """[rad/s]"""
    angular_acceleration: Floats
    """[rad/s^2]"""
    magnetic_field: Floats
    """[T]"""
    orientation: Floats
    """unit quaternion w, x, y, z: world from IMU"""
    acquired: float
    """when it was measured [s], in the clock of ``now``"""
    age: float
    """how old it was at the last update [s]"""
    quality: int
    """as of ``JointState``"""


@final
@dataclass(frozen=True)
class Missing:
    """Who is missing."""

    gateway: str
    """``not_started``, ``running``, ``stuck``, ``ended`` or ``killed``"""
    estimator: str
    """the same"""
    is_nobody: bool
    """both are running, and nothing else is wrong"""
    text: str
    """the same and what else is wrong, in words"""


_T = TypeVar("_T")


def _words(enumeration: str, prefix: str) -> Dict[int, str]:
    """The values of an enumeration of the header, in words."""
    elements = ffi.typeof(enumeration).elements
    return {value: name[len(prefix) :].lower() for value, name in elements.items()}


STATUS = _words("proprio_status", "PROPRIO_")
"""The numbers of ``Torques.status`` in words."""
_REASON = _words("proprio_reason", "PROPRIO_REASON_")
_PRESENCE = _words("proprio_presence", "PROPRIO_")


def _text(array: Any) -> str:
    return bytes(ffi.string(array)).decode("utf-8", "replace")


def _python(field: Any) -> Any:
    """A field of a structure of C as a number or an array of its own."""
    if isinstance(field, (int, float)):
        return field
    return np.array(list(field))


def _bytes(name: str) -> bytes:
    if "\0" in name:
        raise ValueError(f"{name!r} is no name")
    return name.encode()


# Between them Python handles signals: Ctrl-C ends a wait.
_SLICE = 100_000_000


class RobotReader:
    """The newest state of one robot.

    It may be made before the robot's gateway and estimator run, and finds them again after a
    restart in any order. Torques and contacts older than ``max_age`` [s] are stale, measurements
    after the maximum silence of their channel. ``runtime_dir`` and ``domain`` name the domain;
    else the environment does (PROPRIO_RUNTIME_DIR, PROPRIO_DOMAIN).

    Threads may share it: each call sees the state of the last update by any of them. A child of a
    process that forks makes its own. Raises RuntimeError if it cannot be made, and ValueError when
    it is used after ``close``.
    """

    def __init__(
        self,
        robot: str,
        max_age: float = 0.05,
        runtime_dir: "Optional[Union[str, os.PathLike[str]]]" = None,
        domain: Optional[str] = None,
    ) -> None:
        def text(of: Optional[str]) -> Any:
            return ffi.NULL if of is None else ffi.new("char[]", _bytes(of))

        if not max_age >= 0:
            raise ValueError(f"max_age is a duration in seconds, not {max_age}")
        base = None if runtime_dir is None else os.fspath(runtime_dir)
        name, base, own = text(robot), text(base), text(domain)
        nanoseconds = round(min(max_age, 9e9) * 1e9)
        why = ffi.new("char[]", 512)
        reader = lib.proprio_reader_new(name, nanoseconds, base, own, why, 512)
        if reader == ffi.NULL:
            raise RuntimeError(_text(why))
        self._open: Any = ffi.gc(reader, lib.proprio_reader_free)
        self._lock = threading.Lock()
        self._handles: Dict[Tuple[object, str], Any] = {}
        self._arrays: Dict[Tuple[str, ...], Any] = {}

    @property
    def _reader(self) -> Any:
        """The reader of C, for calls with the lock held."""
        if self._open is None:
            raise ValueError("the reader is closed")
        return self._open

    def close(self) -> None:
        """Ends the reader, as soon as no other thread is in a call."""
        with self._lock:
            if self._open is not None:
                ffi.release(self._open)
                self._open = None

    def __enter__(self) -> "RobotReader":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def update(self) -> None:
        """Takes what has arrived. Once in each cycle, before values are read."""
        with self._lock:
            lib.proprio_update(self._reader, lib.proprio_now())

    def wait_for_estimate(self, timeout: float) -> bool:
        """Waits for an estimate, at most ``timeout`` [s], and takes it; whether one may have come.
        Other threads of Python run meanwhile."""
        return self._wait(lib.proprio_wait_for_estimate, timeout)

    def wait_for_sample(self, timeout: float) -> bool:
        """As ``wait_for_estimate``, for a sample of any channel."""
        return self._wait(lib.proprio_wait_for_sample, timeout)

    def _wait(self, function: Callable[[Any, int], bool], timeout: float) -> bool:
        deadline = lib.proprio_now() + round(max(0.0, min(timeout, 9e9)) * 1e9)
        while True:
            with self._lock:
                came = bool(function(self._reader, min(deadline, lib.proprio_now() + _SLICE)))
                lib.proprio_update(self._reader, lib.proprio_now())
            if came or lib.proprio_now() >= deadline:
                return came

    def torque(self, joint: str) -> Union[Torque, Unavailable]:
        """The torque of a joint as of the last update, or why there is none."""
        return self._read(Torque, "proprio_torque *", lib.proprio_read_torque, joint)

    def torques(self, joints: Optional[Sequence[str]] = None) -> Torques:
        """The torques of these joints (all, if none are named) as arrays, as of the last update."""
        if isinstance(joints, str):
            raise TypeError("joints is a list of names, not one name")
        names = tuple(self.torque_names() if joints is None else joints)
        torque = np.full(len(names), math.nan)
        deviation = np.full(len(names), math.nan)
        status = np.full(len(names), lib.PROPRIO_UNKNOWN, dtype=np.int32)
        acquired = ffi.new("int64_t *")
        with self._lock:
            handles = self._arrays.get(names)
            if handles is None:
                handles = ffi.new("proprio_torque_handle[]", max(1, len(names)))
                for place, name in enumerate(names):
                    handles[place] = self._handle(lib.proprio_read_torque, name)
                self._arrays[names] = handles
            available = lib.proprio_read_torques(
                self._reader,
                handles,
                len(names),
                ffi.from_buffer("double[]", torque),
                ffi.from_buffer("double[]", deviation),
                ffi.cast("proprio_status *", ffi.from_buffer(status)),
                acquired,
            )
        instant = acquired[0] * 1e-9 if available else math.nan
        return Torques(names, torque, deviation, status, instant)

    def contact(self, contact: str) -> Union[Contact, Unavailable]:
        """The wrench of a contact as of the last update, or why there is none."""
        return self._read(Contact, "proprio_contact *", lib.proprio_read_contact, contact)

    def joint(self, joint: str) -> Union[JointState, Unavailable]:
        """The state of a joint as its device reports it, or why there is none."""
        return self._read(JointState, "proprio_joint_state *", lib.proprio_read_joint, joint)

    def wrench(self, sensor: str) -> Union[Wrench, Unavailable]:
        """A force/torque sensor's reading, or why there is none."""
        return self._read(Wrench, "proprio_wrench *", lib.proprio_read_wrench, sensor)

    def imu(self, sensor: str) -> Union[Imu, Unavailable]:
        """An inertial measurement unit's reading, or why there is none."""
        return self._read(Imu, "proprio_imu *", lib.proprio_read_imu, sensor)

    def torque_names(self) -> List[str]:
        """The estimator's joints in its order; empty until it has been seen."""
        return self._names(lib.proprio_torque_name)

    def contact_names(self) -> List[str]:
        """The estimator's contacts."""
        return self._names(lib.proprio_contact_name)

    def channel_names(self) -> List[Tuple[int, str]]:
        """The gateway's channels: kind (``JOINT``, ``WRENCH``, ``IMU`` or another) and name."""
        name, kind = ffi.new("char[]", lib.PROPRIO_NAME_SIZE), ffi.new("uint32_t *")
        all: List[Tuple[int, str]] = []
        with self._lock:
            while lib.proprio_channel_name(self._reader, len(all), name, kind):
                all.append((kind[0], _text(name)))
        return all

    def who_is_missing(self) -> Missing:
        """Who is missing, and what to do."""
        missing = ffi.new("proprio_missing *")
        with self._lock:
            lib.proprio_who_is_missing(self._reader, missing)
        return Missing(
            _PRESENCE[missing.gateway],
            _PRESENCE[missing.estimator],
            bool(missing.is_nobody),
            _text(missing.text),
        )

    def _names(self, function: Callable[[Any, int, Any], bool]) -> List[str]:
        name = ffi.new("char[]", lib.PROPRIO_NAME_SIZE)
        all: List[str] = []
        with self._lock:
            while function(self._reader, len(all), name):
                all.append(_text(name))
        return all

    def _handle(self, function: Callable[..., int], name: str) -> Any:
        """The handle by which a function reads this name, with the lock held."""
        key = (function, name)
        handle = self._handles.get(key)
        if handle is None:
            handle = self._handles[key] = _FIND[function](self._reader, _bytes(name))
        return handle

    def _read(
        self, type: Type[_T], structure: str, function: Callable[..., int], name: str
    ) -> Union[_T, Unavailable]:
        value, why = ffi.new(structure), ffi.new("proprio_unavailable *")
        with self._lock:
            handle = self._handle(function, name)
            status = function(self._reader, handle, value, why)
        if status != lib.PROPRIO_OK:
            text = ffi.new("char[]", 256)
            lib.proprio_describe(why, text, 256)
            withheld = status == lib.PROPRIO_WITHHELD
            return Unavailable(
                status=STATUS[status],
                reason=_REASON[why.reason] if withheld else None,
                channel=_text(why.channel) or None if withheld else None,
                age=why.age * 1e-9,
                text=_text(text),
            )
        names = [field.name for field in dataclasses.fields(cast(Any, type))]
        fields = {name: _python(getattr(value, name)) for name in names}
        fields["acquired"] *= 1e-9
        fields["age"] *= 1e-9
        return type(**fields)


def _channel(kind: int) -> Callable[[Any, bytes], Any]:
    return lambda reader, name: lib.proprio_find_channel(reader, kind, name)


# How the handle is found by which a function reads.
_FIND: Dict[Any, Callable[[Any, bytes], Any]] = {
    lib.proprio_read_torque: lib.proprio_find_torque,
    lib.proprio_read_contact: lib.proprio_find_contact,
    lib.proprio_read_joint: _channel(JOINT),
    lib.proprio_read_wrench: _channel(WRENCH),
    lib.proprio_read_imu: _channel(IMU),
}
