// SPDX-License-Identifier: Apache-2.0
//
// make_drive BAG MAP: records a drive of 24 s around a synthetic city block as a
// spinning LiDAR with 64 beams would see it, and a map of the same block.
//
//   /points_raw    sensor_msgs/PointCloud2, 10 Hz, 60,000 points of 32 bytes (x, y, z, intensity)
//   /ground_truth  geometry_msgs/PoseStamped, where the scan was taken
//
// Every scan has exactly as many points, so that a position in the stream of
// messages tells whether it is the beginning of one.  240 scans are once around:
// the last is followed by the first.  The map is a file of floats, x y z each point.
#include <geometry_msgs/PoseStamped.h>
#include <rosbag/bag.h>
#include <sensor_msgs/PointCloud2.h>

#include <cstdio>
#include <limits>
#include <set>
#include <tuple>

#include "city.h"

namespace {

constexpr int kScans = 240, kBeams = 64, kColumns = 1040, kPoints = 60000;
constexpr double kPeriod = 0.1, kHeight = 1.8, kFar = 130, kNoise = 0.015;
constexpr double kLowest = -24.8, kHighest = 6.0; // of the beams, degrees

struct Point {
	float x, y, z, padding, intensity, more[3];
};
static_assert(sizeof(Point) == 32, "PCL's PointXYZI");

// Distance to a box along a ray, or infinity.
double hit(const Vec &from, const Vec &inverse, const Box &box)
{
	const double x0 = (box.low.x - from.x) * inverse.x, x1 = (box.high.x - from.x) * inverse.x;
	const double y0 = (box.low.y - from.y) * inverse.y, y1 = (box.high.y - from.y) * inverse.y;
	const double z0 = (box.low.z - from.z) * inverse.z, z1 = (box.high.z - from.z) * inverse.z;
	const double in = std::max({ std::min(x0, x1), std::min(y0, y1), std::min(z0, z1) });
	const double out = std::min({ std::max(x0, x1), std::max(y0, y1), std::max(z0, z1) });

	return in > 0 && in <= out ? in : std::numeric_limits<double>::infinity();
}

// What is seen, in the sensor's own frame.
std::vector<Point> scan(const std::vector<Box> &city, const Pose &pose, std::mt19937 &random)
{
	std::normal_distribution<double> noise(0, kNoise);
	const Vec from{ pose.x, pose.y, kHeight };
	std::vector<Point> points;

	points.reserve(kBeams * kColumns);
	for (int column = 0; column < kColumns; column++)
		for (int beam = 0; beam < kBeams; beam++) {
			const double elevation =
				(kLowest + (kHighest - kLowest) * beam / (kBeams - 1)) * M_PI / 180;
			const double azimuth = 2 * M_PI * column / kColumns;
			const double c = std::cos(elevation), z = std::sin(elevation);
			const Vec to{ c * std::cos(azimuth + pose.yaw), c * std::sin(azimuth + pose.yaw), z };
			const Vec inverse{ 1 / to.x, 1 / to.y, 1 / to.z };
			double distance = z < 0 ? -kHeight / z : std::numeric_limits<double>::infinity();
			float intensity = 0.1F;

			for (size_t i = 0; i < city.size(); i++) {
				const double to_box = hit(from, inverse, city[i]);
				if (to_box < distance) {
					distance = to_box;
					intensity = 0.2F + 0.01F * static_cast<float>(i % 70);
				}
			}
			if (distance > kFar)
				continue;
			distance += noise(random);
			points.push_back({ static_cast<float>(distance * c * std::cos(azimuth)),
					   static_cast<float>(distance * c * std::sin(azimuth)),
					   static_cast<float>(distance * z), 0, intensity, {} });
		}
	return points;
}

sensor_msgs::PointCloud2 message(const std::vector<Point> &points)
{
	sensor_msgs::PointCloud2 cloud;
	const char *const names[] = { "x", "y", "z", "intensity" };
	const uint32_t offsets[] = { 0, 4, 8, 16 };

	for (int i = 0; i < 4; i++) {
		sensor_msgs::PointField field;
		field.name = names[i];
		field.offset = offsets[i];
		field.datatype = sensor_msgs::PointField::FLOAT32;
		field.count = 1;
		cloud.fields.push_back(field);
	}
	cloud.height = 1;
	cloud.width = kPoints;
	cloud.point_step = sizeof(Point);
	cloud.row_step = kPoints * sizeof(Point);
	cloud.is_dense = true;
	cloud.data.resize(cloud.row_step);
	// As many as said, evenly taken from those there are.
	for (size_t i = 0; i < kPoints; i++)
		std::memcpy(&cloud.data[i * sizeof(Point)], &points[i * points.size() / kPoints],
			    sizeof(Point));
	return cloud;
}

} // namespace

int main(int argc, char **argv)
{
	if (argc != 3) {
		std::fprintf(stderr, "usage: make_drive BAG MAP\n");
		return 2;
	}
	const std::vector<Box> city = make_city();
	const Circuit circuit;
	std::mt19937 random(1);
	std::set<std::tuple<int, int, int>> seen; // cells of 0.2 m that are in the map
	std::vector<float> map;
	rosbag::Bag bag(argv[1], rosbag::bagmode::Write);

	for (int i = 0; i < kScans; i++) {
		const Pose pose = circuit.at(circuit.length() * i / kScans);
		const std::vector<Point> points = scan(city, pose, random);
		const ros::Time stamp(1700000000 + i * kPeriod);
		const double c = std::cos(pose.yaw), s = std::sin(pose.yaw);

		if (points.size() < kPoints) {
			std::fprintf(stderr, "scan %d has %zu points only\n", i, points.size());
			return 1;
		}
		for (const Point &p : points) {
			const double x = pose.x + c * p.x - s * p.y, y = pose.y + s * p.x + c * p.y,
				     z = kHeight + p.z;
			if (i % 4 == 0 && std::hypot(p.x, p.y) < 60 &&
			    seen.emplace(static_cast<int>(std::floor(x / 0.2)), static_cast<int>(std::floor(y / 0.2)),
					 static_cast<int>(std::floor(z / 0.2)))
				    .second)
				map.insert(map.end(), { static_cast<float>(x), static_cast<float>(y), static_cast<float>(z) });
		}
		geometry_msgs::PoseStamped truth;
		truth.header.stamp = stamp;
		truth.header.seq = static_cast<uint32_t>(i);
		truth.header.frame_id = "map";
		truth.pose.position.x = pose.x;
		truth.pose.position.y = pose.y;
		truth.pose.position.z = kHeight;
		truth.pose.orientation.z = std::sin(pose.yaw / 2);
		truth.pose.orientation.w = std::cos(pose.yaw / 2);
		sensor_msgs::PointCloud2 cloud = message(points);
		cloud.header.stamp = stamp;
		cloud.header.seq = static_cast<uint32_t>(i);
		cloud.header.frame_id = "lidar";
		// Before its scan, also when they are sorted by time.
		bag.write("/ground_truth", stamp - ros::Duration(0.001), truth);
		bag.write("/points_raw", stamp, cloud);
	}
	bag.close();
	FILE *file = std::fopen(argv[2], "wb");
	if (!file || std::fwrite(map.data(), sizeof(float), map.size(), file) != map.size() || std::fclose(file)) {
		std::perror(argv[2]);
		return 1;
	}
	std::printf("%d scans of %d points; a map of %zu points\n", kScans, kPoints, map.size() / 3);
	return 0;
}
