// SPDX-License-Identifier: Apache-2.0
//
// Crashes on order, for the benchmark: `echo "KIND PLACE" > $FAULTS/NODE` makes the
// node crash once, the next time it comes to that place.  A file, because a restored
// process forgets what it was told, and would crash again and again.
#pragma once

#include <fcntl.h>
#include <unistd.h>

#include <csignal>
#include <cstdlib>
#include <cstring>
#include <stdexcept>
#include <string>

inline void crash(const std::string &kind)
{
	if (kind == "segv")
		*static_cast<volatile int *>(nullptr) = 1;
	if (kind == "abort")
		std::abort();
	if (kind == "throw")
		throw std::runtime_error("a fault, on order");
	if (kind == "kill")
		raise(SIGKILL);
	_exit(3);
}

class Faults
{
      public:
	explicit Faults(const std::string &node)
	{
		const char *folder = std::getenv("FAULTS");
		if (folder)
			path_ = std::string(folder) + "/" + node;
	}

	// Crashes here if that was ordered.
	void at(const char *place) const
	{
		char text[64] = "";
		const int fd = path_.empty() ? -1 : open(path_.c_str(), O_RDONLY | O_CLOEXEC);
		if (fd < 0)
			return;
		const ssize_t bytes = read(fd, text, sizeof text - 1);
		close(fd);
		const std::string order(text, bytes > 0 ? static_cast<size_t>(bytes) : 0);
		const size_t space = order.find(' ');
		if (space == std::string::npos ||
		    order.compare(space + 1, std::strlen(place), place) != 0)
			return;
		unlink(path_.c_str());
		crash(order.substr(0, space));
	}

      private:
	std::string path_;
};
