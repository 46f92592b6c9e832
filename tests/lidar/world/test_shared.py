"""What worlds share is made once, and let go when no world has it and others are kept."""

import gc
import threading
import time
import weakref

from lidar.world.shared import Shared


class _Value:
    pass


def test_a_value_is_made_again_only_when_no_one_holds_it():
    shared: Shared[_Value] = Shared()
    held = shared.get("a", _Value)
    assert shared.get("a", _Value) is held
    shared.keep([held])
    known = weakref.ref(held)
    del held
    gc.collect()
    assert shared.get("a", _Value) is known()
    shared.keep([])
    gc.collect()
    assert known() is None


def test_threads_make_a_value_once():
    shared: Shared[_Value] = Shared()
    made = []

    def make():
        time.sleep(0.05)
        made.append(_Value())
        return made[-1]

    threads = [threading.Thread(target=shared.get, args=("a", make)) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(made) == 1
