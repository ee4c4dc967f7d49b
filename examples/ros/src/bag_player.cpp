// SPDX-License-Identifier: Apache-2.0
//
// bag_player: plays a recorded drive again and again, as a LiDAR driver would
// publish it: each scan with the stamp of now.  (rosbag play keeps the stamps of the
// recording, and a latency could not be told from them.)
//
//   /points_raw    the scans          /ground_truth  where each was taken
//   /gnss          a rough position with every scan, for nodes that start
//
// Parameters: ~bag, ~period (0.1 s)
#include <geometry_msgs/PoseStamped.h>
#include <ros/ros.h>
#include <rosbag/bag.h>
#include <rosbag/view.h>
#include <sensor_msgs/PointCloud2.h>

#include <cmath>
#include <ctime>

namespace {

void sleep_until(timespec &at, double more)
{
	const int64_t ns = at.tv_nsec + static_cast<int64_t>(more * 1e9);
	at.tv_sec += ns / 1000000000;
	at.tv_nsec = ns % 1000000000;
	while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &at, nullptr) == EINTR) {
	}
	timespec now{};
	clock_gettime(CLOCK_MONOTONIC, &now);
	if (now.tv_sec > at.tv_sec + 1)
		at = now; // stood still for long: no hurry to make up for it
}

} // namespace

int main(int argc, char **argv)
{
	ros::init(argc, argv, "bag_player");
	ros::NodeHandle node, own("~");
	std::string path;
	double period = 0.1;

	own.getParam("bag", path);
	own.getParam("period", period);
	ros::Publisher points = node.advertise<sensor_msgs::PointCloud2>("/points_raw", 2);
	ros::Publisher truth = node.advertise<geometry_msgs::PoseStamped>("/ground_truth", 100);
	ros::Publisher gnss = node.advertise<geometry_msgs::PoseStamped>("/gnss", 100);
	rosbag::Bag bag(path, rosbag::bagmode::Read);
	rosbag::View view(bag);
	ros::AsyncSpinner spinner(1);
	spinner.start();

	uint32_t number = 0;
	geometry_msgs::PoseStamped where;
	timespec at{};
	clock_gettime(CLOCK_MONOTONIC, &at);
	while (ros::ok())
		for (const rosbag::MessageInstance &message : view) {
			if (auto pose = message.instantiate<geometry_msgs::PoseStamped>()) {
				where = *pose;
				continue;
			}
			auto cloud = message.instantiate<sensor_msgs::PointCloud2>();
			if (!cloud)
				continue;
			sleep_until(at, period);
			if (!ros::ok())
				break;
			cloud->header.stamp = where.header.stamp = ros::Time::now();
			cloud->header.seq = where.header.seq = ++number;
			geometry_msgs::PoseStamped rough = where; // 0.4 m beside the truth
			rough.pose.position.x += 0.4 * std::cos(number);
			rough.pose.position.y += 0.4 * std::sin(number);
			truth.publish(where);
			gnss.publish(rough);
			points.publish(cloud);
		}
	return 0;
}
