# SPDX-License-Identifier: Apache-2.0
"""
Where chips wait for the ground.

`SpoolWriter` stores them, `SpoolReleaser` claims them, `SpoolConsole` shows and changes them, all
three in transactions of one `Catalogue` with the tables and rules of `books`. `OutboxFeeder` moves
them to the `Outbox`. `salvage` reads damaged catalogues. Ship lists wait in a `ListSpool`, in a
catalogue of their own; `ListFeeder` releases them before any chip. No ROS in here.
"""
