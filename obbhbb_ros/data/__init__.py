# SPDX-License-Identifier: Apache-2.0
"""The data files of the package."""

# Label file of the synthetic harbour that `obbhbb_ros.study.harbour` draws.
HARBOUR = 'harbour.csv'
# Width and height of its image, pixels.
HARBOUR_SIZE = (1024, 768)
