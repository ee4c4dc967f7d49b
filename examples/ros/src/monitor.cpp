// SPDX-License-Identifier: Apache-2.0
//
// monitor: the end of the chain.  Says once a second how it is doing, and writes one
// line for each message into ~log, for the benchmark:
//
//   KIND ARRIVED SEQ STAMP X Y YAW
//
// KIND: T (ground truth, with each scan), V (the voxel filter's cloud; X is its
// points), P (pose), O (obstacle node; X is the distance).  ARRIVED and STAMP are
// seconds since 1970; a scan's STAMP is when it was published.
#include <geometry_msgs/PointStamped.h>
#include <geometry_msgs/PoseStamped.h>
#include <ros/ros.h>
#include <sensor_msgs/PointCloud2.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <map>
#include <vector>

namespace {

class Monitor {
public:
	Monitor() : own_("~")
	{
		std::string path;
		if (own_.getParam("log", path) && !(log_ = std::fopen(path.c_str(), "ae"))) {
			ROS_FATAL("%s cannot be written", path.c_str());
			std::exit(1);
		}
		const ros::TransportHints hints = ros::TransportHints().tcpNoDelay();
		subscribers_ = {
			own_.subscribe("/ground_truth", 100, &Monitor::truth, this, hints),
			own_.subscribe("/points_filtered", 100, &Monitor::filtered, this, hints),
			own_.subscribe("/ndt_pose", 100, &Monitor::pose, this, hints),
			own_.subscribe("/obstacle_ahead", 100, &Monitor::obstacle, this, hints),
		};
		timer_ = own_.createWallTimer(ros::WallDuration(1.0), &Monitor::report, this);
	}

private:
	void write(char kind, const std_msgs::Header &header, double x, double y, double yaw)
	{
		if (!log_)
			return;
		std::fprintf(log_, "%c %.6f %u %.6f %.4f %.4f %.5f\n", kind, ros::WallTime::now().toSec(), header.seq,
			     header.stamp.toSec(), x, y, yaw);
		std::fflush(log_);
	}

	static double yaw_of(const geometry_msgs::PoseStamped &pose)
	{
		return 2 * std::atan2(pose.pose.orientation.z, pose.pose.orientation.w);
	}

	void truth(const geometry_msgs::PoseStamped::ConstPtr &pose)
	{
		write('T', pose->header, pose->pose.position.x, pose->pose.position.y, yaw_of(*pose));
		truths_[pose->header.stamp] = *pose;
		if (truths_.size() > 100)
			truths_.erase(truths_.begin());
	}

	void filtered(const sensor_msgs::PointCloud2::ConstPtr &cloud)
	{
		write('V', cloud->header, cloud->width, 0, 0);
	}

	void pose(const geometry_msgs::PoseStamped::ConstPtr &pose)
	{
		const ros::WallTime now = ros::WallTime::now();
		const auto &at = pose->pose.position;

		write('P', pose->header, at.x, at.y, yaw_of(*pose));
		latencies_.push_back(now.toSec() - pose->header.stamp.toSec());
		if (!last_.isZero())
			longest_ = std::max(longest_, (now - last_).toSec());
		last_ = now;
		const auto truth = truths_.find(pose->header.stamp);
		if (truth != truths_.end())
			error_ = std::max(error_, std::hypot(at.x - truth->second.pose.position.x,
							     at.y - truth->second.pose.position.y));
	}

	void obstacle(const geometry_msgs::PointStamped::ConstPtr &point)
	{
		write('O', point->header, point->point.x, 0, 0);
	}

	void report(const ros::WallTimerEvent &)
	{
		std::sort(latencies_.begin(), latencies_.end());
		if (latencies_.empty())
			std::printf("no poses\n");
		else
			std::printf("%zu poses, latency median %.1f max %.1f ms, longest interval %.0f ms, error %.2f m\n",
				    latencies_.size(), latencies_[latencies_.size() / 2] * 1e3,
				    latencies_.back() * 1e3, longest_ * 1e3, error_);
		std::fflush(stdout);
		latencies_.clear();
		longest_ = error_ = 0;
	}

	ros::NodeHandle own_;
	FILE *log_ = nullptr;
	std::vector<ros::Subscriber> subscribers_;
	ros::WallTimer timer_;
	std::map<ros::Time, geometry_msgs::PoseStamped> truths_;
	std::vector<double> latencies_;
	ros::WallTime last_;
	double longest_ = 0, error_ = 0;
};

} // namespace

int main(int argc, char **argv)
{
	ros::init(argc, argv, "monitor");
	Monitor monitor;
	ros::spin();
	return 0;
}
