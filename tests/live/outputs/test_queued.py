"""Whoever hands a message to an output returns at once, and what a receiver misses is counted."""

from __future__ import annotations

import threading

import pytest
from live_messages import make_event, make_state, until

from tapetum.errors import InputError
from tapetum.live.outputs import Queued, open_output


class Hanging(Queued):
    """Takes a message and waits until it is let go."""

    def __init__(self, **limits: int) -> None:
        super().__init__("hanging", patience=0.05, **limits)
        self.go, self.taken = threading.Event(), []

    def send_event(self, event):
        self.taken.append(event)
        self.go.wait()

    send_state = send_event


def test_a_receiver_that_hangs_costs_only_its_own_messages():
    output = Hanging(events=5)
    output.start()
    output.event(make_event(0))
    until(lambda: len(output.taken) == 1)
    # Every call returns though nothing is ever taken: otherwise this test would not end.
    for number in range(1, 101):
        output.event(make_event(number))
    assert output.counts.waiting == 5 and output.counts.dropped == 95 and output.counts.sent == 0
    output.go.set()
    until(lambda: output.counts.sent == 6)
    assert [event.id for event in output.taken[1:]] == [f"event-{number}" for number in range(96, 101)]
    output.close()


def test_closing_before_a_receiver_that_hangs_returns_and_counts_what_is_lost():
    output = Hanging()
    output.start()
    for number in range(4):
        output.event(make_event(number))
    until(lambda: len(output.taken) == 1)
    output.close()
    output.event(make_event(9))
    assert output.counts.dropped == 3 and output.counts.waiting == 0
    output.go.set()


def test_states_push_out_no_events_and_only_the_newest_is_kept():
    output = Hanging(events=5, states=1)
    output.start()
    output.state(make_state(0))
    until(lambda: len(output.taken) == 1)
    output.event(make_event(7))
    for number in range(1, 50):
        output.state(make_state(number))
    assert output.counts.waiting == 2 and output.counts.dropped == 0
    output.go.set()
    until(lambda: output.counts.sent == 3)
    assert output.taken[1].id == "event-7" and output.taken[2].frame == 49
    output.close()


def test_a_failure_is_counted_and_the_next_message_tried():
    class Failing(Queued):
        def send_event(self, event):
            if event.id == "event-0":
                raise OSError("no way there")

    output = Failing("failing")
    output.start()
    output.event(make_event(0))
    until(lambda: output.counts.failed == 1)
    assert output.counts.fault == "no way there"
    output.event(make_event(1))
    until(lambda: output.counts.sent == 1)
    assert output.counts.fault == ""
    output.close()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("telegram://me", "unknown kind of output 'telegram://me'; use one of osc:…"),
        ("nothing", "unknown kind of output 'nothing'"),
        ("osc://127.0.0.1", "no port in 'osc://127.0.0.1'; write osc://host:port"),
        ("osc://127.0.0.1:70000", "port out of range"),
        ("osc://127.0.0.1:9000/here", "more than host and port"),
        ("https:///hook", "no host"),
        ("http://me:secret@:80/", "no host in 'http://…@:80/'"),
    ],
)
def test_a_text_that_names_no_receiver_is_refused_with_a_remedy(text, says):
    with pytest.raises(InputError) as caught:
        open_output(text)
    assert says in str(caught.value) and "secret" not in str(caught.value)
