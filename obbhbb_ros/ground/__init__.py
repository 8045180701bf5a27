# SPDX-License-Identifier: Apache-2.0
"""What came down: the chips and ship lists of an outbox, as pages, tables and maps."""
