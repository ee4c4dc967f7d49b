#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""obstacle_watch (rospy): how far it is to the next thing ahead of the car.

~input (sensor_msgs/PointCloud2, /points_filtered) -> /obstacle_ahead (geometry_msgs/PointStamped)
"""

import numpy as np
import rospy
from geometry_msgs.msg import PointStamped
from sensor_msgs.msg import PointCloud2

HALF_WIDTH_M = 1.2
CLEAR_M = 100.0


def nearest(cloud):
    """Metres to the nearest point in the car's own lane, above the road."""
    count = cloud.width * cloud.height
    raw = np.frombuffer(cloud.data, np.uint8).reshape(count, cloud.point_step)[:, :12]
    x, y, z = np.ascontiguousarray(raw).view(np.float32).T
    ahead = x[(x > 2.0) & (abs(y) < HALF_WIDTH_M) & (z > -1.2)]
    return float(ahead.min()) if len(ahead) else CLEAR_M


def main():
    """The node."""
    rospy.init_node("obstacle_watch")
    publisher = rospy.Publisher("/obstacle_ahead", PointStamped, queue_size=10)

    def look(cloud):
        found = PointStamped(header=cloud.header)
        found.point.x = nearest(cloud)
        publisher.publish(found)

    rospy.Subscriber(rospy.get_param("~input", "/points_filtered"), PointCloud2, look, tcp_nodelay=True)
    rospy.spin()


if __name__ == "__main__":
    main()
