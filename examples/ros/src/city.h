// SPDX-License-Identifier: Apache-2.0
//
// A synthetic city block: a road around it, facades on both sides, parked cars,
// poles and trees, all of them boxes; and the car's way around the block.
#pragma once

#include <algorithm>
#include <cmath>
#include <random>
#include <vector>

struct Vec {
	double x, y, z;
};

struct Box {
	Vec low, high;
};

struct Pose {
	double x, y, yaw;
};

// The middle of the road: a rectangle with round corners, once around.
class Circuit
{
      public:
	static constexpr double kWidth = 70, kDepth = 60, kCorner = 22;

	double length() const
	{
		return 2 * (kWidth + kDepth - 4 * kCorner) + 2 * M_PI * kCorner;
	}

	// Where one is after so many metres, driving counter-clockwise.
	Pose at(double way) const
	{
		const double straight[4] = { kWidth - 2 * kCorner, kDepth - 2 * kCorner,
					     kWidth - 2 * kCorner, kDepth - 2 * kCorner };
		const double arc = M_PI / 2 * kCorner;
		Pose p{ -kWidth / 2 + kCorner, -kDepth / 2, 0 };

		way = std::fmod(way, length());
		for (int side = 0; side < 4; side++) {
			const double c = std::cos(p.yaw), s = std::sin(p.yaw);
			const double ahead = std::min(way, straight[side]);

			p.x += c * ahead;
			p.y += s * ahead;
			if (way <= straight[side])
				return p;
			way -= straight[side];
			const double turn = std::min(way, arc) / kCorner;
			p.x += kCorner * (std::sin(p.yaw + turn) - s);
			p.y -= kCorner * (std::cos(p.yaw + turn) - c);
			p.yaw += turn;
			if (way <= arc)
				return p;
			way -= arc;
		}
		return p;
	}
};

// Always the same city: it has its own random numbers.
inline std::vector<Box> make_city()
{
	std::mt19937 random(20240501);
	std::vector<Box> city;
	auto uniform = [&](double low, double high) {
		return std::uniform_real_distribution<double>(low, high)(random);
	};
	auto box = [&](double x0, double x1, double y0, double y1, double z0, double z1) {
		city.push_back({ { std::min(x0, x1), std::min(y0, y1), z0 },
				 { std::max(x0, x1), std::max(y0, y1), z1 } });
	};
	const double half[2] = { Circuit::kWidth / 2, Circuit::kDepth / 2 };

	// Each side of the road: 4 streets, inside (-1) and outside (+1) of the circuit.
	for (int street = 0; street < 4; street++)
		for (int out = -1; out <= 1; out += 2) {
			const int across = street % 2; // the street runs along the other axis
			const double sign = street < 2 ? -1 : 1;
			const double along_half = half[1 - across] + (out > 0 ? 40 : -9);
			auto put = [&](double a0, double a1, double b0, double b1, double z0,
				       double z1) {
				// a along the street, b metres away from its middle.
				const double middle = sign * half[across];
				const double n = sign * out;
				if (across == 0)
					box(middle + n * b0, middle + n * b1, a0, a1, z0, z1);
				else
					box(a0, a1, middle + n * b0, middle + n * b1, z0, z1);
			};
			for (double a = -along_half; a < along_half;) {
				const double width = uniform(4, 9);
				const double front = uniform(9, 10.8);
				const double height = uniform(9, 22);

				// Now and then a side street, with a house at its end.
				if (out > 0 && uniform(0, 1) < 0.12)
					put(a, a + width, 45, 50, 0, height);
				else {
					put(a, a + width, front, front + 8, 0, height);
					if (uniform(0, 1) < 0.5) // a balcony
						put(a + 1, a + width - 1, front - 1, front, 3, 4);
				}
				a += width;
			}
			const double near_half = half[1 - across] - Circuit::kCorner;
			for (double a = -near_half; a < near_half; a += uniform(7, 15)) {
				if (uniform(0, 1) < 0.6) // a parked car
					put(a, a + 4.3, 4, 5.8, 0.3, 1.5);
				if (uniform(0, 1) < 0.7) // a lamp post
					put(a + 5.2, a + 5.45, 6.6, 6.85, 0, 7);
				if (uniform(0, 1) < 0.4) { // a tree
					put(a + 2, a + 2.4, 7.2, 7.6, 0, 3);
					put(a + 1, a + 3.4, 6.4, 8.6, 3, 6);
				}
			}
		}
	// The end of the world, so that nearly every ray comes back.
	box(-120, -119, -120, 120, 0, 30);
	box(119, 120, -120, 120, 0, 30);
	box(-120, 120, -120, -119, 0, 30);
	box(-120, 120, 119, 120, 0, 30);
	return city;
}
