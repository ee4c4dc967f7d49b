// SPDX-License-Identifier: Apache-2.0
// crash TRIGGER: the runtime reports the fault and exits with status 2.
package main

import (
	"os"
	"time"
)

func main() {
	var wild *int

	for i := 0; i < 4; i++ {
		go func() {
			for {
				time.Sleep(time.Millisecond)
			}
		}()
	}
	for {
		time.Sleep(5 * time.Millisecond)
		if _, err := os.Stat(os.Args[1]); err == nil {
			os.Remove(os.Args[1])
			crashes, _ := os.OpenFile(os.Args[1]+".crashes", os.O_APPEND|os.O_CREATE|os.O_WRONLY, 0600)
			crashes.WriteString(".")
			*wild = 1
		}
	}
}
