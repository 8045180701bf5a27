# SPDX-License-Identifier: Apache-2.0
"""Settings for all tests."""

from hypothesis import settings

# No deadline: a slow machine is no error. Half the examples of the default: there are many
# properties, and `--hypothesis-profile=default` is there for more.
settings.register_profile('house', max_examples=50, deadline=None)
settings.load_profile('house')
