# SPDX-License-Identifier: Apache-2.0
"""What was found in an image, drawn over it: what belongs together, pictures and markers."""
