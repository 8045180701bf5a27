# SPDX-License-Identifier: Apache-2.0
"""
Build script, for colcon (ament_python) and for pip.

There is no `pyproject.toml` on purpose: `colcon build` for ament_python calls `setup.py` and reads
`setup.cfg`, so it would state the same facts a second time. The linter's settings are in
`ruff.toml`, those of pytest and mypy in `setup.cfg`; version, license and maintainer in
`package.xml` alone.
"""

from glob import glob
from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages
from setuptools import setup

PACKAGE = 'obbhbb_ros'
MANIFEST = ElementTree.parse(Path(__file__).with_name('package.xml')).getroot()
MAINTAINER = MANIFEST.find('maintainer')

EXECUTABLES = (
    'obb_to_hbb',
    'chip_extractor',
    'downlink',
    'overlay',
    'play_detections',
    'ship_tracker',
    'payload',
)

ROS = [
    'ros-jazzy-rclpy',
    'ros-jazzy-common-interfaces',
    # rclpy needs a middleware and does not ask for one.
    'ros-jazzy-rmw-fastrtps-cpp',
]
PLOTS = ['matplotlib>=3.6', 'jinja2>=3.0']
# The font of the overlay is in all sizes from 10.1 on.
IMAGES = ['pillow>=10.1']
# The peers of the benchmarks.
PEERS = ['supervision>=0.27']
# What the places of ships are held against in the tests.
GEODESY = ['pymap3d>=3.0']
GEO = ['geopandas>=0.14', 'pyogrio>=0.7', 'pyproj>=3.4', 'rasterio>=1.3']
ARROW = ['pyarrow>=16.0']
# What loads our labels in the tests, where it is installed.
TOOLS = ['pycocotools>=2.0', *PEERS, 'ultralytics>=8.3']
# What the page on Arrow shows.
ENGINES = ['duckdb>=1.5', 'dask[dataframe,distributed]>=2024.1']
PROGRESS = ['tqdm>=4.60']
BAGS = ['rosbags>=0.11.9', 'mcap>=1.2', 'pyyaml>=5.4']
LINT = ['mypy>=1.8', 'ruff~=0.17.0']
# Drives a Chromium that is on the machine.
BROWSER = ['playwright>=1.40']
# The second is for pip before 24, which cannot find the version that cfdp-py needs by itself.
CFDP = ['cfdp-py>=0.7', 'fastcrc~=0.3.0']

setup(
    name=PACKAGE,
    version=MANIFEST.findtext('version'),
    description=' '.join(MANIFEST.findtext('description').split()),
    long_description=Path(__file__).with_name('README.md').read_text(encoding='utf-8'),
    long_description_content_type='text/markdown',
    license=MANIFEST.findtext('license'),
    author=MANIFEST.findtext('author'),
    author_email=MANIFEST.find('author').get('email'),
    maintainer=MAINTAINER.text,
    maintainer_email=MAINTAINER.get('email'),
    url=MANIFEST.findtext('url'),
    classifiers=[
        'Development Status :: 4 - Beta',
        'Intended Audience :: Developers',
        'Intended Audience :: Science/Research',
        'License :: OSI Approved :: Apache Software License',
        'Operating System :: POSIX :: Linux',
        'Programming Language :: Python :: 3',
        *(f'Programming Language :: Python :: 3.{minor}' for minor in range(10, 15)),
        'Topic :: Scientific/Engineering :: Image Processing',
        'Typing :: Typed',
    ],
    packages=find_packages(include=[PACKAGE, f'{PACKAGE}.*']),
    package_data={
        PACKAGE: ['py.typed', 'data/*', 'templates/*'],
        f'{PACKAGE}.ground': ['templates/*'],
        f'{PACKAGE}.study': ['templates/*'],
    },
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{PACKAGE}']),
        (f'share/{PACKAGE}', ['package.xml']),
        (f'share/{PACKAGE}/config', sorted(glob('config/*.*'))),
        (f'share/{PACKAGE}/config/security', sorted(glob('config/security/*'))),
        (f'share/{PACKAGE}/launch', sorted(glob('launch/*.launch.py'))),
    ],
    python_requires='>=3.10',
    install_requires=['numpy>=1.23', 'shapely>=2.0'],
    extras_require={
        'jazzy': ROS,
        'plots': PLOTS,
        'images': IMAGES,
        'chips': IMAGES,
        'bench': PEERS,
        'tools': TOOLS,
        'geo': GEO,
        # What the GeoPandas of Ubuntu 24.04 reads shapefiles with, in place of pyogrio.
        'fiona': ['fiona>=1.9'],
        'arrow': ARROW,
        'browser': BROWSER,
        'progress': PROGRESS,
        'bags': BAGS,
        'test': [
            'hypothesis>=6.80',
            'pytest>=7.4',
            'pytest-xdist>=3.4',
            'colcon-common-extensions',
            *ARROW,
            *BAGS,
            *CFDP,
            *ENGINES,
            *GEO,
            *GEODESY,
            *IMAGES,
            *LINT,
        ],
    },
    entry_points={
        'console_scripts': [
            f'obbhbb = {PACKAGE}.cli:main',
            *(f'{name} = {PACKAGE}.nodes.__main__:main' for name in EXECUTABLES),
        ],
    },
    zip_safe=False,
)
