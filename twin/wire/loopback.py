"""Where emulated devices may be reached: from this machine alone, unless told otherwise."""

import ipaddress

from greenough.instrument.errors import InputError


def check_loopback(host: str, allow_remote: bool = False) -> None:
    """Raise InputError unless ``host`` is a loopback address, or ``allow_remote`` says that others are meant.

    Only literal addresses and ``localhost`` are taken: what another name stands for is up to the network.
    """
    if host == "localhost":
        return
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        raise InputError(
            f"an emulated device cannot listen on {host!r}: give an address, 127.0.0.1 for this machine alone"
        ) from None
    if not (address.is_loopback or allow_remote):
        raise InputError(
            f"an emulated device would be reachable from other machines on {host}: listen on 127.0.0.1, or allow "
            "remote clients explicitly"
        )
