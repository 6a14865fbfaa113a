"""Built by colcon, in a workspace of ROS 2."""

from setuptools import setup

NAME = "blimp_ros"

setup(
    name=NAME,
    version="0.2.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/bridge.launch.xml"]),
    ],
    install_requires=["setuptools"],
    entry_points={"console_scripts": [f"bridge = {NAME}.bridge:main"]},
)
