"""One setup for both ways to install: pip into a virtual environment, and colcon (ament_python)."""

from pathlib import Path

from setuptools import setup

PACKAGE = "attitude_alignment"
SHARE = f"share/{PACKAGE}"


def shared_files(*patterns):
    """Return (install folder, files) pairs for the files that match, folder by folder."""
    folders = {}
    for pattern in patterns:
        for path in sorted(Path().glob(pattern)):
            folders.setdefault(f"{SHARE}/{path.parent.as_posix()}", []).append(path.as_posix())
    return list(folders.items())


setup(
    name=PACKAGE,
    version="0.1.0",
    description="Roll and pitch from one IMU and an altimeter that hold in turns, braking and aerobatics.",
    license="Apache-2.0",
    maintainer="attitude_alignment maintainers",
    maintainer_email="maintainers@attitude-alignment.example",
    packages=["inertial", "attitude_estimator", "attitude_estimator.navigation", "alignment", "alignment.standing",
              "nav_ros", "studies"],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (SHARE, ["package.xml"]),
        *shared_files("config/*.yaml", "launch/*.launch.py", "bags/*/metadata.yaml", "bags/*/*.mcap"),
    ],
    zip_safe=True,
    python_requires=">=3.10",
    # rosbags brings what else reads bags: apsw, lz4 and, before Python 3.14, backports.zstd.
    install_requires=["numba", "numpy>=1.26,<3", "rosbags>=0.11", "ruamel.yaml", "tqdm"],
    extras_require={
        # rclpy, the messages and a middleware as wheels; a machine with ROS 2 has its own.
        "ros": [
            f"{wheel}; sys_platform == 'linux' and platform_machine == 'x86_64'"
            for wheel in ("ros-jazzy-rclpy", "ros-jazzy-common-interfaces", "ros-jazzy-rmw-fastrtps-cpp")
        ],
        "study": ["matplotlib"],
        "test": [
            "catkin-pkg",
            "colcon-core",
            "colcon-library-path",
            "colcon-metadata",
            "colcon-notification",
            "colcon-output",
            "colcon-package-information",
            "colcon-package-selection",
            "colcon-python-setup-py",
            "colcon-recursive-crawl",
            "colcon-ros",
            "pytest",
            "pytest-xdist",
            "ruff",
            "scipy",
            "setuptools<80",
        ],
        "bench": ["ahrs", "imufusion", "vqf"],
    },
    entry_points={
        "console_scripts": [
            *(f"{name} = nav_ros.programs:{name}" for name in (
                "attitude_node", "alignment_node", "navigation_node", "replay_node", "estimate_bag", "align_bag",
                "navigate_bag", "simulate_bag", "score_bag", "report_bag", "allan", "attitude_demo")),
            "study_recordings = studies.recordings:main",
            "study_attitude = studies.attitude:main",
            "study_real_effects = studies.real_effects:main",
            "study_other_motions = studies.other_motions:main",
            "study_choice = studies.choice:main",
            "study_north_finding = studies.north_finding:main",
            "study_ins_alignment = studies.ins_alignment:main",
            "study_disturbances = studies.disturbances:main",
            "study_strapdown = studies.strapdown:main",
            "study_helicopter = studies.helicopter:main",
            "study_two_filters = studies.two_filters:main",
        ],
    },
)
