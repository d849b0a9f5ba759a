"""Ground side: reference triangle, control centre, running intervals and routes, redundant links.

Here are the pure parts: verdicts of the triangle and their monitor, states of trains, intervals, routes and points,
supervision, and the on-board end of authorities. The centre at work (`railfix.ground.control`, `railfix.ground.serve`),
its store, page and links need the extra ``railfix[ground]`` and are imported from their modules.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
