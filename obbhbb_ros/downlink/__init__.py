# SPDX-License-Identifier: Apache-2.0
"""From axis-aligned boxes to what is sent: crop plan, chips, link budget. No ROS in here."""


def require_not_negative(**values: float) -> None:
    """Raise ValueError with the name of the first value that is not finite or is negative."""
    for name, value in values.items():
        if not 0 <= value < float('inf'):
            raise ValueError(f'{name} must be finite and not negative, not {value}')
