# SPDX-License-Identifier: Apache-2.0
"""
Ship lists: where ships were seen, in a few bytes each.

`ShipReport` is one ship. `ship_geojson` writes a list as gzipped GeoJSON, `ship_message` as a short
binary message; `read_ship_list` reads both. No ROS in here.
"""
