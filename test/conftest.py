# SPDX-License-Identifier: Apache-2.0
"""Settings for all tests."""

from hypothesis import settings

# No deadline: a slow machine is no error. Half the examples of the default, as there are many
# properties. The same ones at each run, so that a test fails only because of what was changed;
# `explore` looks for new ones.
settings.register_profile('house', max_examples=50, deadline=None, derandomize=True)
settings.register_profile('explore', max_examples=2000, deadline=None)
settings.load_profile('house')
