// SPDX-License-Identifier: Apache-2.0
//
// voxel_grid_filter: thins a point cloud out with PCL's VoxelGrid.
//
//   ~input -> ~output (sensor_msgs/PointCloud2)    Parameters: ~leaf (2.0 m)
#include <pcl/filters/voxel_grid.h>
#include <pcl/point_types.h>
#include <pcl_conversions/pcl_conversions.h>
#include <ros/ros.h>
#include <sensor_msgs/PointCloud2.h>

#include "fault.h"

namespace {

class VoxelGridFilter {
public:
	VoxelGridFilter() : own_("~"), faults_(ros::this_node::getName().substr(1))
	{
		std::string input = "/points_raw", output = "/points_filtered";
		own_.getParam("leaf", leaf_);
		own_.getParam("input", input);
		own_.getParam("output", output);
		publisher_ = own_.advertise<sensor_msgs::PointCloud2>(output, 10);
		subscriber_ = own_.subscribe(input, 10, &VoxelGridFilter::filter, this,
					     ros::TransportHints().tcpNoDelay());
		ROS_INFO("leaf %.2f m", leaf_);
	}

private:
	void filter(const sensor_msgs::PointCloud2::ConstPtr &message)
	{
		faults_.at("begin");
		pcl::PointCloud<pcl::PointXYZI>::Ptr in(new pcl::PointCloud<pcl::PointXYZI>);
		pcl::PointCloud<pcl::PointXYZI> out;
		pcl::VoxelGrid<pcl::PointXYZI> grid;
		const float leaf = static_cast<float>(leaf_);

		pcl::fromROSMsg(*message, *in);
		grid.setLeafSize(leaf, leaf, leaf);
		grid.setInputCloud(in);
		grid.filter(out);
		faults_.at("middle");
		sensor_msgs::PointCloud2 filtered;
		pcl::toROSMsg(out, filtered);
		filtered.header = message->header;
		publisher_.publish(filtered);
		faults_.at("end");
	}

	ros::NodeHandle own_;
	double leaf_ = 2.0;
	Faults faults_;
	ros::Publisher publisher_;
	ros::Subscriber subscriber_;
};

} // namespace

int main(int argc, char **argv)
{
	ros::init(argc, argv, "voxel_grid_filter");
	VoxelGridFilter filter;
	ros::spin();
	return 0;
}
