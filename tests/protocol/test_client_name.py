# SPDX-License-Identifier: MIT
"""A client's name is good with its secret alone."""

import pytest

from protocol.access.client_name import check_client, new_client
from protocol.channels import check_name
from protocol.refused import Refused


def test_a_name_goes_with_its_secret_and_with_no_other() -> None:
    (name, secret), (other, its) = new_client(), new_client()
    assert name != other and secret != its and check_name(name, "client") == name
    check_client(name, secret)
    for wrong in (its, b"", secret[:-1], secret + b"\0", secret * 1000):
        with pytest.raises(Refused, match=rf"Command\.secret does not belong to client '{name}'") as refused:
            check_client(name, wrong)
        assert refused.value.kind == "secret"


@pytest.mark.parametrize("secret", [b"", b"anything"])
def test_names_of_older_clients_are_bound_to_nothing(secret: bytes) -> None:
    for name in ("client-0123abcd", "somebody", ""):
        check_client(name, secret)
