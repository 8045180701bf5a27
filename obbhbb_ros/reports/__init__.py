# SPDX-License-Identifier: Apache-2.0
"""
Ship lists: where each ship was seen, in a few bytes.

`ShipReport` is one ship. `ship_geojson` writes a list as gzipped GeoJSON, `ship_message` as a short
binary message; `read_ship_list` reads both. This room does not use ROS.
"""
