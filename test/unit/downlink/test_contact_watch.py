# SPDX-License-Identifier: Apache-2.0
"""Contact that is not renewed in time counts as lost."""

from obbhbb_ros.downlink.contact_watch import ContactWatch


def test_without_a_timeout_contact_lasts() -> None:
    watch = ContactWatch()
    assert not watch.is_contact
    watch.hear(True, 0.0)
    assert not watch.expire(1e9, 0.0)
    assert watch.is_contact


def test_contact_is_lost_once_and_is_back_with_the_next_message() -> None:
    watch = ContactWatch()
    watch.hear(True, 0.0)
    watch.hear(True, 4.0)
    assert not watch.expire(9.0, 5.0)
    assert watch.expire(9.1, 5.0)
    assert not watch.expire(20.0, 5.0)
    assert (watch.is_contact, watch.is_lost) == (False, True)
    watch.hear(True, 21.0)
    assert (watch.is_contact, watch.is_lost) == (True, False)


def test_the_end_of_contact_need_not_be_renewed() -> None:
    watch = ContactWatch()
    watch.hear(True, 0.0)
    watch.hear(False, 1.0)
    assert not watch.expire(100.0, 5.0)
    assert not watch.is_lost
