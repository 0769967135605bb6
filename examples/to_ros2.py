"""Positions as messages of ROS 2: python to_ros2.py MAP FOLDER

Publishes geometry_msgs/PoseWithCovarianceStamped on /edgevpr/pose, east and north in metres from the first place of the
map. rclpy is that of your ROS 2; without it, the messages are printed.
"""

import math
import sys
from pathlib import Path

import cv2

import edgevpr

METRES_PER_DEGREE = 111_195  # of latitude


def publisher():
    """Return a function that publishes (east_m, north_m, covariance_m2); without ROS 2 it prints them."""
    try:
        import rclpy
        from geometry_msgs.msg import PoseWithCovarianceStamped
    except ImportError:
        return lambda east_m, north_m, covariance_m2: print(f"pose {east_m:.2f} {north_m:.2f} {covariance_m2}")
    rclpy.init()
    node = rclpy.create_node("edgevpr")
    topic = node.create_publisher(PoseWithCovarianceStamped, "/edgevpr/pose", 10)

    def publish(east_m, north_m, covariance_m2):
        message = PoseWithCovarianceStamped()
        message.header.stamp, message.header.frame_id = node.get_clock().now().to_msg(), "map"
        message.pose.pose.position.x, message.pose.pose.position.y = east_m, north_m
        var_east, between, var_north = covariance_m2
        covariance = [0.0] * 36
        covariance[0], covariance[1], covariance[6], covariance[7] = var_east, between, between, var_north
        for unknown in (14, 21, 28, 35):  # height and the three angles
            covariance[unknown] = 1e6
        message.pose.covariance = covariance
        topic.publish(message)

    return publish


def main(path: str, folder: str) -> None:
    publish = publisher()
    with edgevpr.Map(path) as ground:
        home = next(place.position for place in ground.places() if place.position)
        for picture in sorted(Path(folder).glob("*.jpg")):
            match = ground.match(cv2.imread(str(picture)))
            if match.position is None:
                continue
            north_m = (match.position.lat_deg - home.lat_deg) * METRES_PER_DEGREE
            along_m = METRES_PER_DEGREE * math.cos(math.radians(home.lat_deg))
            publish((match.position.lon_deg - home.lon_deg) * along_m, north_m, match.covariance_m2)


if __name__ == "__main__":
    main(*sys.argv[1:])
