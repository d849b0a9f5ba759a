"""Ground side: reference triangle, control centre, running intervals and routes, redundant links.

Storage, links and the page need the extra ``railfix[ground]``; the triangle and the state machines do not.
"""
