"""Ground side: reference triangle, control centre, intervals and routes of trains, and redundant links.

This module exports the parts that do no input or output: the triangle's verdicts, the monitor that acts on the
verdicts, states of trains, intervals, routes, points, and supervision in the centre and on board. The running centre
(`railfix.ground.control`, `railfix.ground.serve`), its store, page and links need the extra ``railfix[ground]`` and are
imported from their modules.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
