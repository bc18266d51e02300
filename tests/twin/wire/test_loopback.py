import pytest

from greenough.instrument.errors import InputError
from greenough.twin.wire.loopback import check_loopback


@pytest.mark.parametrize("host", ["127.0.0.1", "127.3.2.1", "::1", "localhost"])
def test_this_machine_is_taken(host: str) -> None:
    check_loopback(host)


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.100", "10.0.0.1"])
def test_what_others_can_reach_is_refused_unless_it_is_meant(host: str) -> None:
    with pytest.raises(InputError, match=r"127\.0\.0\.1"):
        check_loopback(host)
    check_loopback(host, allow_remote=True)


@pytest.mark.parametrize("host", ["", "example.org", "127.0.0.1.nip.io", "127.1"])
def test_names_are_refused_even_where_remote_clients_are_meant(host: str) -> None:
    with pytest.raises(InputError, match="give an address"):
        check_loopback(host, allow_remote=True)
