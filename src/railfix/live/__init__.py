"""Positioning from live receiver streams: sources, pairing of antennas, one message per period, sinks.

`LiveEngine` computes messages from epochs; it uses no files, clocks or sockets. `run_session` adds the sources and
sinks. `run_live` adds all other functions of ``railfix live``::

    engine = LiveEngine(processor, LiveSettings(train=7))
    engine.add_navigation(navigation)
    engine.push("front", epoch, now_ns=time.monotonic_ns())
    for output in engine.poll(now_ns=time.monotonic_ns()):
        print(output.message.chainage_cm, output.result)
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
