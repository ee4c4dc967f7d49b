// SPDX-License-Identifier: Apache-2.0
//
// ndt_matching: finds the car's pose by matching thinned scans against a map with
// PCL's NormalDistributionsTransform.  The first guesses come from /gnss (0.4 m off),
// every other one from the last two poses: a node that was away for a while looks
// ahead.  A pose that is metres beside /gnss is wrong, and it starts over.
//
//   /points_filtered -> /ndt_pose (geometry_msgs/PoseStamped)
//   Parameters: ~map (file of floats, x y z each point), ~resolution (3.0 m)
#include <geometry_msgs/PoseStamped.h>
#include <pcl/point_types.h>
#include <pcl/registration/ndt.h>
#include <pcl_conversions/pcl_conversions.h>
#include <ros/ros.h>
#include <sensor_msgs/PointCloud2.h>

#include <cmath>
#include <fstream>
#include <map>

#include "fault.h"

namespace {

using Cloud = pcl::PointCloud<pcl::PointXYZ>;

constexpr double kHeight = 1.8;
// Longer ahead than this no car is predicted.
constexpr double kPredict_s = 3.0;
// So many first guesses are from /gnss.
constexpr uint64_t kGuided = 3;
constexpr size_t kHeard = 100;
// Metres off /gnss.
constexpr double kWrong = 3.0;

struct Planar {
	double x, y, yaw;
};

double turned(double angle) { return std::remainder(angle, 2 * M_PI); }

Cloud::Ptr read_map(const std::string &path)
{
	Cloud::Ptr map(new Cloud);
	std::ifstream file(path, std::ios::binary);
	float xyz[3];

	while (file.read(reinterpret_cast<char *>(xyz), sizeof xyz))
		map->push_back(pcl::PointXYZ(xyz[0], xyz[1], xyz[2]));
	return map;
}

class NdtMatching {
public:
	NdtMatching() : own_("~"), faults_(ros::this_node::getName().substr(1))
	{
		std::string path;
		double resolution = 3.0;
		own_.getParam("map", path);
		own_.getParam("resolution", resolution);
		Cloud::Ptr map = read_map(path);
		if (map->empty()) {
			ROS_FATAL("no map in '%s' (~map)", path.c_str());
			std::exit(1);
		}
		ndt_.setResolution(static_cast<float>(resolution));
		ndt_.setInputTarget(map);
		ndt_.setMaximumIterations(30);
		ndt_.setStepSize(1.0);
		ndt_.setTransformationEpsilon(1e-4); // compared with the *squared* step in PCL 1.13
		publisher_ = own_.advertise<geometry_msgs::PoseStamped>("/ndt_pose", 10);
		const ros::TransportHints hints = ros::TransportHints().tcpNoDelay();
		gnss_ = own_.subscribe("/gnss", 100, &NdtMatching::hear, this, hints);
		points_ = own_.subscribe("/points_filtered", 10, &NdtMatching::match, this, hints);
		ROS_INFO("map of %zu points, resolution %.2f m", map->size(), resolution);
	}

private:
	void hear(const geometry_msgs::PoseStamped::ConstPtr &rough)
	{
		const auto &q = rough->pose.orientation;
		heard_[rough->header.stamp] = { rough->pose.position.x, rough->pose.position.y,
						2 * std::atan2(q.z, q.w) };
		while (heard_.size() > kHeard)
			heard_.erase(heard_.begin());
	}

	Planar predict(const ros::Time &stamp) const
	{
		const double dt = std::min((stamp - last_stamp_).toSec(), kPredict_s);
		const double way = speed_ * dt, turn = turning_ * dt;
		// Along the middle of the arc.
		return { last_.x + way * std::cos(last_.yaw + turn / 2),
			 last_.y + way * std::sin(last_.yaw + turn / 2), last_.yaw + turn };
	}

	void match(const sensor_msgs::PointCloud2::ConstPtr &message)
	{
		const ros::Time stamp = message->header.stamp;
		const auto rough = heard_.find(stamp);
		const bool guided = matched_ < kGuided;
		if (guided && rough == heard_.end())
			return;
		faults_.at("begin");
		const Planar guess = guided ? rough->second : predict(stamp);
		Cloud::Ptr in(new Cloud);
		Cloud aligned;
		const Eigen::Affine3f first =
			Eigen::Translation3f(static_cast<float>(guess.x), static_cast<float>(guess.y),
					     static_cast<float>(kHeight)) *
			Eigen::AngleAxisf(static_cast<float>(guess.yaw), Eigen::Vector3f::UnitZ());

		pcl::fromROSMsg(*message, *in);
		ndt_.setInputSource(in);
		ndt_.align(aligned, first.matrix());
		faults_.at("middle");
		const Eigen::Matrix4f found = ndt_.getFinalTransformation();
		const Planar now{ found(0, 3), found(1, 3), std::atan2(found(1, 0), found(0, 0)) };
		const double dt = (stamp - last_stamp_).toSec();

		if (matched_ > 0 && dt > 0.01) {
			speed_ = std::hypot(now.x - last_.x, now.y - last_.y) / dt;
			turning_ = turned(now.yaw - last_.yaw) / dt;
		}
		last_ = now;
		last_stamp_ = stamp;
		matched_++;
		if (rough != heard_.end() &&
		    std::hypot(now.x - rough->second.x, now.y - rough->second.y) > kWrong) {
			ROS_WARN("lost track");
			matched_ = 0;
		}
		geometry_msgs::PoseStamped pose;
		pose.header = message->header;
		pose.header.frame_id = "map";
		pose.pose.position.x = now.x;
		pose.pose.position.y = now.y;
		pose.pose.position.z = found(2, 3);
		pose.pose.orientation.z = std::sin(now.yaw / 2);
		pose.pose.orientation.w = std::cos(now.yaw / 2);
		publisher_.publish(pose);
		faults_.at("end");
	}

	ros::NodeHandle own_;
	Faults faults_;
	pcl::NormalDistributionsTransform<pcl::PointXYZ, pcl::PointXYZ> ndt_;
	ros::Publisher publisher_;
	ros::Subscriber gnss_, points_;
	std::map<ros::Time, Planar> heard_;
	Planar last_{};
	uint64_t matched_ = 0;
	ros::Time last_stamp_;
	double speed_ = 0, turning_ = 0;
};

} // namespace

int main(int argc, char **argv)
{
	ros::init(argc, argv, "ndt_matching");
	NdtMatching matching;
	ros::spin();
	return 0;
}
